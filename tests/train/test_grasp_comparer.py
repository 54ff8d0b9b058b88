"""The comparer learns what is alike; what it learns from is the object where it says so."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from toys import bump, lay, table, toy

from qsgm.bundle import load_bundle
from qsgm.grasp.cells import Cells
from qsgm.grasp.comparer import Comparer
from qsgm.grasp.correlation import Template
from qsgm.grasp.network import GRASPNET
from qsgm.grasp.patch import cut_patch
from qsgm.grasp.task import GraspTask
from qsgm.paths import bundle_folder
from qsgm.task import task_record
from qsgm.train.checkpoint import Checkpoint, save_checkpoint
from qsgm.train.grasp.comparer import (
    Batch,
    Batches,
    Chance,
    ComparerConfig,
    ComparerNet,
    shipped_comparer,
    train_comparer,
    varied,
)
from qsgm.train.grasp.comparer_examples import Examples, draw_examples
from qsgm.train.grasp.episodes import Episode, EpisodeMaker, EpisodesConfig
from qsgm.train.grasp.teach_comparer import teach_comparer
from qsgm.train.model.net import ConvNet
from qsgm.train.model.sgm import Sgm

CENTER = (320.0, 240.0)
CELLS = Cells.of(Template(cut_patch(lay(toy(), table(), CENTER), CENTER)))
FEW = EpisodesConfig(episodes=1, scenes=3, tables=2, others=12)
SMALL = ComparerConfig((6, 6, 6, 6), hidden=8, steps=120, batch=16, of_the_object=8)


def alike_or_not(count: int = 64) -> Examples:
    """Stripes seen again, or stripes across."""
    rng = np.random.default_rng(0)
    stripes = np.where(np.arange(64) // 8 % 2, 60, 190).astype(np.uint8)
    taught = np.broadcast_to(stripes[None, :, None, None], (1, 64, 64, 3)).copy()
    mine = np.arange(count) % 2 == 0
    seen = np.where(mine[:, None, None, None], taught, taught.transpose(0, 2, 1, 3))
    noisy = np.clip(seen + rng.normal(0, 6, seen.shape), 0, 255).astype(np.uint8)
    solid = np.full((1, 64, 64), 255, np.uint8)
    return Examples(taught, solid, noisy, np.zeros(count, np.int64), mine)


def nowhere(frame: NDArray[np.uint8]) -> NDArray[np.float32]:
    """The heatmap of a network that sees nothing."""
    rows, cols = ((side - 128) // 16 + 1 for side in frame.shape[:2])
    return np.full((3, rows, cols), 0.5, np.float32)


def test_what_is_frozen_answers_as_what_was_learnt() -> None:
    torch.manual_seed(0)
    net = ComparerNet((4, 5, 6, 7), 8)
    frozen = net.frozen()
    for one, layer in zip(net.convolutions, frozen.convolutions, strict=True):
        weight = torch.from_numpy(layer.weight).reshape(3, 3, -1, len(layer.bias))
        one.weight.data = weight.permute(3, 2, 0, 1).contiguous()
    for one, layer in ((net.hidden, frozen.hidden), (net.output, frozen.output)):
        one.weight.data = torch.from_numpy(layer.weight).T.contiguous()
    seen = np.random.default_rng(0).integers(0, 256, (3, 64, 64, 3)).astype(np.uint8)
    taught, views = (
        torch.from_numpy(some).permute(0, 3, 1, 2).float()
        for some in (np.repeat(CELLS.image[None], 3, axis=0), seen)
    )
    solid = torch.from_numpy(CELLS.solid)[None, None].expand(3, 1, 64, 64)
    with torch.no_grad():
        expected = net(taught, views, solid).numpy()
    np.testing.assert_allclose(frozen.logits(CELLS, seen), expected, atol=1e-5)


def test_it_learns_to_tell_what_is_alike_from_what_is_not() -> None:
    examples, steps = alike_or_not(), list[tuple[int, int]]()
    learnt = train_comparer(
        examples, SMALL, 0, "cpu", lambda _, done, of, *__: steps.append((done, of))
    )
    assert steps[-1] == (SMALL.steps, SMALL.steps)
    taught, everywhere = examples.taught[0].astype(np.float32), np.ones((64, 64), np.float32)
    whole = replace(CELLS, image=taught, solid=everywhere)
    logits = learnt.logits(whole, examples.seen)
    assert (logits[examples.mine] > logits[~examples.mine].max()).mean() > 0.95


def test_varied_examples_keep_the_object_where_its_mask_is() -> None:
    chance, examples = Chance(torch.Generator().manual_seed(0)), alike_or_not(8)
    solid = np.zeros((1, 64, 64), np.uint8)
    solid[:, :20, :30] = 255
    bright = np.repeat(solid[..., None], 3, axis=3)
    lit = Examples(bright, solid, np.repeat(bright, 8, axis=0), examples.of, examples.mine)
    batches = Batches(lit, SMALL, 0, "cpu")
    corners = set[int]()
    for _ in range(40):
        batch: Batch = varied(batches.of(torch.arange(8)), chance)
        inside = batch.solid.expand_as(batch.taught) > 0.5
        (on,), (off,) = batch.taught[inside].unique(), batch.taught[~inside].unique()
        assert {float(on), float(off)} == {0.0, 255.0}
        assert batch.seen.min() >= 0
        assert batch.seen.max() <= 255
        # Of eight views some are covered, none of them all over.
        contrast = batch.seen[inside].mean() - batch.seen[~inside].mean()
        assert (contrast > 50) if on > off else (contrast < -50)
        corners.add(int(batch.solid[0].flatten().argmax()))
    assert len(corners) >= 4  # turned and mirrored


def test_another_thing_where_the_object_was_is_not_the_object(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A network that sees that thing: of scenes without the object no example is of it."""
    places = dict[int, tuple[float, float]]()
    draw = EpisodeMaker.draw

    def without_alone(*given: Any, **more: Any) -> Episode:
        episode = draw(*given, **more)
        there = [scene for scene in episode.without if scene.center_px is not None]
        places.update({id(one.image): one.center_px for one in there if one.center_px})
        return replace(episode, scenes=(), without=tuple(there))

    monkeypatch.setattr(EpisodeMaker, "draw", without_alone)
    config = replace(FEW, scenes=8)
    examples = draw_examples(lambda frame: bump([places[id(frame)]]), config, 1, lambda: None)
    assert len(places) > 1
    assert len(examples) > len(places)
    assert not examples.mine.any()


def test_examples_show_the_object_where_they_say_so() -> None:
    """A network that sees nothing proposes places anywhere; the true poses are there anyway."""
    told = list[int]()
    examples = draw_examples(nowhere, FEW, 3, lambda: told.append(1))
    assert len(told) == len(examples.taught) == 1
    assert examples.mine.any()
    assert not examples.mine.all()
    taught, weight = examples.taught[0].astype(float), examples.solid[0] / 255.0
    away = np.abs(examples.seen - taught).mean(axis=3)
    off = (away * weight).sum(axis=(1, 2)) / weight.sum()
    assert np.median(off[examples.mine]) < np.median(off[~examples.mine])


def test_a_batch_has_as_many_of_the_object_as_told_and_each_beside_its_own() -> None:
    """Objects of one grey each: what is taught and seen agree where it is the object's."""
    count = 40
    levels = np.arange(count, dtype=np.uint8) * 6
    taught = np.broadcast_to(levels[:, None, None, None], (count, 64, 64, 3)).copy()
    examples = Examples(
        taught,
        np.full((count, 64, 64), 255, np.uint8),
        taught,
        np.arange(count),
        np.arange(count) % 4 == 0,
    )
    batches = Batches(examples, SMALL, 0, "cpu")
    batch = batches.of(torch.tensor([3, 8]))
    assert batch.taught[:, 0, 0, 0].tolist() == batch.seen[:, 0, 0, 0].tolist() == [18.0, 48.0]
    drawn = batches.draw()
    assert len(drawn.seen) == len(batches.truth) == SMALL.batch
    greys = {float(grey) for grey in drawn.taught[: SMALL.of_the_object, 0, 0, 0]}
    of_objects = {6.0 * k for k in range(0, count, 4)}
    assert greys <= of_objects or greys <= {255 - grey for grey in of_objects}
    assert batches.truth.tolist() == [1.0] * 8 + [0.0] * 8


def test_the_shipped_comparer_tells_a_thing_from_another_and_is_what_is_shipped() -> None:
    comparer = shipped_comparer()
    other = lay(toy(), np.ascontiguousarray(255 - table()), CENTER, 90)
    seen = np.rint([CELLS.image, Cells.of(Template(cut_patch(other, CENTER))).image])
    same, another = comparer.logits(CELLS, seen.astype(np.uint8))
    assert same > 0 > another
    decision = load_bundle(bundle_folder()).manifest.task.settings["decision"]
    assert decision["comparer"] == comparer.to_json()


def test_teach_comparer_writes_the_same_numbers_however_many_processes_draw(
    tmp_path: Path,
) -> None:
    sgms, rates = {5: Sgm(GRASPNET, 5, (4,)).eval()}, {"6": (0.1,), "5,6": (0.1, 0.1)}
    net = ConvNet(GRASPNET).eval()
    untouched = Checkpoint(task_record(GraspTask()), net, sgms, {}, rates, {})
    save_checkpoint(tmp_path / "sgm.pt", untouched)
    taught = []
    for processes in (1, 2):
        stages = list[str]()
        output = tmp_path / f"{processes}.json"
        few, small = replace(FEW, episodes=2, scenes=1), replace(SMALL, steps=2)

        def watch(stage: str, *_: object, stages: list[str] = stages) -> None:
            stages.append(stage)

        teach_comparer(tmp_path / "sgm.pt", output, 0, "cpu", processes, watch, few, small)
        assert stages == ["examples"] * 2 + ["comparer"] * 2
        taught.append(Comparer.from_json(json.loads(output.read_text()), "it").to_json())
    assert taught[0] == taught[1] != shipped_comparer().to_json()
