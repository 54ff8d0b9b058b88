"""Another task goes the whole way: pretrained, folded, calibrated, exported, tuned, compared."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch.nn import functional as F
from toy_task import ToyLesson, ToyTask

from qsgm import Bundle, Settings, load_bundle, prepare, resolve
from qsgm.manifest import PRECISIONS, Precision
from qsgm.train.checkpoint import Checkpoint, load_checkpoint
from qsgm.train.export import ExportOptions, export_bundle
from qsgm.train.model.fold import fold_net, run_folded
from qsgm.train.pretraining.backbone import BackboneConfig
from qsgm.train.pretraining.maml import MamlConfig
from qsgm.train.pretraining.map_sgms import MapConfig
from qsgm.train.pretraining.matching import MatchingConfig
from qsgm.train.pretraining.pretrain import PretrainConfig, pretrain
from qsgm.train.pretraining.rates import RatesConfig
from qsgm.tune.run import train, tune

TASK = ToyTask()
# Seconds, and enough to beat chance by far.
SMALL = PretrainConfig(
    hidden=(16,),
    first_rates=(1e-3, 3e-3, 3e-2),
    tasks=8,
    crops_per_task=100,
    backbone=BackboneConfig(steps=120, crops_per_frame=20, loader_processes=0),
    matching=MatchingConfig(epochs=2, fit_steps=150, fit_batch=128),
    maml=MamlConfig(outer_steps=20, tasks_per_step=2, unroll=6, run_lengths=(12, 25)),
    early=MapConfig(tasks=4, crops_per_task=40, epochs=2, looks=(1, 2), steps=20, tasks_per_step=2),
    rates=RatesConfig(
        tasks=3,
        crops_per_task=100,
        epochs=8,
        short_epochs=1,
        early_tasks=1,
        early_crops_per_task=40,
        early_epochs=1,
    ),
)


@dataclass(frozen=True)
class ToyLessons:
    """What is calibrated on."""

    sha256: str = "none"

    def __len__(self) -> int:
        return 4

    def lesson(self, i: int, rng: np.random.Generator, count: int) -> ToyLesson:  # noqa: ARG002
        return TASK.lesson(rng, count)

    def samples(
        self,
        i: int,  # noqa: ARG002
        rng: np.random.Generator,
        count: int,
    ) -> NDArray[np.uint8]:
        return TASK.lesson(rng, count).pixels


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("toy") / "toy.pt"
    pretrain(TASK, path, 0, "cpu", lambda *_: None, SMALL)
    return path


@pytest.fixture(scope="module")
def bundle(checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    folder = tmp_path_factory.mktemp("toy") / "bundle"
    options = ExportOptions(epochs=2)
    export_bundle(checkpoint, ToyLessons(), folder, {}, lambda *_: None, options)
    return load_bundle(folder)


@pytest.fixture(scope="module")
def lesson() -> ToyLesson:
    return TASK.lesson(np.random.default_rng(77), 500)


def test_a_checkpoint_names_its_task_and_network(checkpoint: Path) -> None:
    loaded: Checkpoint = load_checkpoint(checkpoint)
    assert loaded.task.name == "toy"
    assert loaded.task.network == TASK.network
    assert loaded.task.heads == TASK.heads
    assert sorted(loaded.sgms) == [1, 2, 3]


def test_a_manifest_says_what_it_was_given(bundle: Bundle) -> None:
    again = load_bundle(bundle.folder).manifest
    assert again.to_json() == bundle.manifest.to_json()
    assert again.network == TASK.network
    assert again.blocks[:4] == ("4", "3,4", "2,3,4", "1,2,3,4")


def test_its_model_card_speaks_of_no_other_task(bundle: Bundle) -> None:
    card = (bundle.folder / "README.md").read_text()
    assert f"for the task `{bundle.manifest.task.name}`" in card
    assert f"`step_float_*_A-{bundle.network.depth}.onnx`" in card
    for word in ("GraspNet", "distractors", "frame", "heatmap", "crop"):
        assert word not in card.split("```json")[0]


def test_the_network_in_onnx_answers_as_the_folded_one_in_torch(
    bundle: Bundle, checkpoint: Path, lesson: ToyLesson
) -> None:
    session = bundle.session("network.onnx")
    folded = fold_net(load_checkpoint(checkpoint).net)
    for pixels in lesson.pixels[:5]:
        (heatmap,) = session.run(None, {"frame": pixels})
        raw = run_folded(folded, torch.from_numpy(pixels[None]))[0, :, 0, 0]
        np.testing.assert_allclose(heatmap[:, 0, 0], raw.softmax(dim=0).numpy(), atol=1e-5)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_tuning_by_an_sgm_learns_what_shapes_mean(
    bundle: Bundle, lesson: ToyLesson, precision: Precision
) -> None:
    plan = resolve(Settings(precision=precision, layers=2, epochs=6), bundle)
    result = tune(prepare(lesson, bundle, plan), plan)
    before, after = result.untouched["accuracy"], result.scores["accuracy"]
    assert before is not None
    assert after is not None
    assert after > 0.9
    assert 1 - after < (1 - before) / 3
    (fidelity,) = result.fidelity.values()
    assert fidelity.cos_int8_float > 0.999


def test_a_run_with_an_sgm_behind_maps_is_the_same_in_every_precision_of_the_frozen_layers(
    bundle: Bundle, lesson: ToyLesson
) -> None:
    losses = []
    for trunk in PRECISIONS:
        plan = resolve(Settings(layers=3, epochs=1, trunk=trunk), bundle)
        losses.append(train(prepare(lesson, bundle, plan), plan).losses[0])
    assert losses[0] == pytest.approx(losses[1], rel=0.02)


@pytest.mark.parametrize("layers", [1, 2, 3, 4])
def test_backpropagation_in_the_engine_steps_as_torchs(
    bundle: Bundle, lesson: ToyLesson, layers: int
) -> None:
    plan = resolve(Settings(method="bp", layers=layers, epochs=1, optimizer="sgd"), bundle)
    # One batch that holds everything, so that there is one step to compare.
    few = ToyLesson(lesson.pixels[:40], lesson.labels[:40], 32)
    prepared = prepare(few, bundle, plan)
    result = train(prepared, plan)
    rate, start = plan.recipe.rates[0], bundle.start_weights(bundle.network.last(4))
    tensors = {k: torch.from_numpy(v).double().requires_grad_() for k, v in start.items()}
    x = torch.from_numpy(few.pixels[:32]).permute(0, 3, 1, 2).double() / 127.5 - 1
    if layers < 4:  # features are kept in u8, and so are seen by the tuned layers
        first, steps = 5 - layers, bundle.network.layer(5 - layers).into
        features = torch.from_numpy(prepared.features[:32]).double()
        side = bundle.network.before(first)
        x = features.transpose(1, 2).unflatten(2, side)
        x = x * torch.from_numpy(steps_of(bundle, first, steps))[:, None, None]
    for number in bundle.network.last(layers):
        layer = bundle.network.layer(number)
        weight, bias = tensors[f"weight{number}"], tensors[f"bias{number}"]
        x = F.conv2d(x, weight, bias, layer.stride, padding=layer.padding)
        x = F.relu(x) if layer.relu else x
        x = F.avg_pool2d(x, layer.pool, layer.pool_stride)
    labels = torch.from_numpy(few.labels[:32]).double()
    F.cross_entropy(x.flatten(1), labels, label_smoothing=0.05).backward()
    for name, tuned in result.weights.items():
        moved = tuned.astype(np.float64) - start[name]
        gradient = tensors[name].grad
        assert gradient is not None
        expected = -rate * gradient.numpy()
        assert np.abs(moved - expected).max() <= 1e-3 * np.abs(expected).max() + 1e-7


def steps_of(bundle: Bundle, first: int, channels: int) -> NDArray[np.float64]:
    """What a code of each feature channel stands for, read off the trunk's own rounding."""
    import onnx
    from onnx import numpy_helper

    model = onnx.load(bundle.graph_path(f"trunk_float_{bundle.network.depth + 1 - first}.onnx"))
    (node,) = (one for one in model.graph.node if one.op_type == "QuantizeLinear")
    (scale,) = (one for one in model.graph.initializer if one.name == node.input[1])
    assert numpy_helper.to_array(scale).shape == (channels,)
    return numpy_helper.to_array(scale).astype(np.float64)
