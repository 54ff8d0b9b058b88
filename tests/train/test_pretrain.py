"""Pretraining as a whole, in a size that takes seconds."""

import hashlib
import math
from collections.abc import Callable
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import pytest
import torch

from qsgm.blocks import single_layers
from qsgm.errors import QsgmError
from qsgm.grasp.network import GRASPNET
from qsgm.grasp.task import grasp_task
from qsgm.train.checkpoint import load_checkpoint
from qsgm.train.grasp.comparer import shipped_comparer
from qsgm.train.grasp.decision import DecisionConfig
from qsgm.train.grasp.decision_scenes import DecisionScenesConfig
from qsgm.train.grasp.pretrain import DecisionStage, pretrain_grasping
from qsgm.train.grasp.task import DrawnGrasping
from qsgm.train.pretraining import pretrain as module
from qsgm.train.pretraining import rates as rates_module
from qsgm.train.pretraining import resume as partial_module
from qsgm.train.pretraining.backbone import BackboneConfig
from qsgm.train.pretraining.evaluate import Score
from qsgm.train.pretraining.maml import MamlConfig, MetaTraining
from qsgm.train.pretraining.map_sgms import MapConfig
from qsgm.train.pretraining.matching import MatchingConfig
from qsgm.train.pretraining.pretrain import PretrainConfig
from qsgm.train.pretraining.rates import RatesConfig
from qsgm.train.pretraining.resume import Partial

TINY = PretrainConfig(
    hidden=(8,),
    tasks=2,
    crops_per_task=50,
    backbone=BackboneConfig(steps=4, frames_per_batch=2, crops_per_frame=8, loader_processes=0),
    matching=MatchingConfig(epochs=1, record_every=1, fit_steps=4, fit_batch=16),
    maml=MamlConfig(outer_steps=2, tasks_per_step=2, unroll=2, warm_up=1),
    early=MapConfig(
        tasks=2,
        crops_per_task=20,
        epochs=1,
        looks=(1,),
        steps=2,
        tasks_per_step=1,
        crops_per_step=2,
    ),
    rates=RatesConfig(
        tasks=1,
        crops_per_task=50,
        epochs=1,
        early_tasks=1,
        early_crops_per_task=10,
        early_epochs=1,
    ),
)
TASK = DrawnGrasping()
LAST = DecisionStage(
    TASK,
    shipped_comparer(),
    DecisionScenesConfig(episodes=2, scenes=2, tables=2, others=12, crops=20, support=16, epochs=1),
    DecisionConfig(hidden=4, steps=5, folds=2),
)


def silent(stage: str, done: int, total: int, figures: dict[str, float]) -> None:
    """Watch without a word."""


def test_pretraining_ends_in_a_checkpoint_that_loads_and_says_how_it_was_made(
    tmp_path: Path,
) -> None:
    stages: list[str] = []

    def watch(stage: str, done: int, total: int, _: dict[str, float]) -> None:
        assert 0 < done <= total
        stages.append(stage)

    pretrain_grasping(TASK, tmp_path / "sgm.pt", 3, "cpu", watch, TINY, LAST)
    checkpoint = load_checkpoint(tmp_path / "sgm.pt")
    assert sorted(checkpoint.sgms) == [1, 2, 3, 4, 5]
    assert sorted(checkpoint.curvatures) == [4, 5, 6]
    singles = {str(single_layers(GRASPNET.last(tuned))): tuned for tuned in range(1, 7)}
    blocks = {"3-4,5,6": 4, "2-4,5,6": 5, "1-4,5,6": 6}
    assert {b: len(rates) for b, rates in checkpoint.rates.items()} == singles | blocks
    assert checkpoint.rates["3-4,5,6"][1:] == checkpoint.rates["4,5,6"]
    assert checkpoint.card["command"] == "qsgm pretrain -o sgm.pt --seed 3 --hidden 8"
    assert list(dict.fromkeys(stages)) == [
        "backbone",
        "tasks",
        "matching",
        "meta",
        "early",
        "rates",
        "decision",
    ]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["sgm.md", "sgm.pt"]
    assert (checkpoint.card["device"], checkpoint.card["resumed"]) == ("cpu", False)
    text = (tmp_path / "sgm.md").read_text()
    assert checkpoint.card["command"] in text
    assert "resumed" not in text


def test_the_same_seed_gives_the_same_checkpoint_and_another_seed_another(tmp_path: Path) -> None:
    nets = [
        pretrain_grasping(
            TASK, tmp_path / f"{i}.pt", seed, "cpu", silent, TINY, LAST
        ).net.state_dict()
        for i, seed in enumerate((0, 0, 1))
    ]
    assert all(torch.equal(a, nets[1][name]) for name, a in nets[0].items())
    assert not all(torch.equal(a, nets[2][name]) for name, a in nets[0].items())


def test_an_interrupted_pretraining_goes_on_where_it_stopped(tmp_path: Path) -> None:
    def interrupt(stage: str, *_: object) -> None:
        if stage == "meta":
            raise KeyboardInterrupt

    output = tmp_path / "sgm.pt"
    with pytest.raises(KeyboardInterrupt):
        pretrain_grasping(TASK, output, 0, "cpu", interrupt, TINY, LAST)
    assert not output.exists()
    stages: set[str] = set()
    resumed = pretrain_grasping(
        TASK, output, 0, "cpu", lambda stage, *_: stages.add(stage), TINY, LAST
    )
    assert "backbone" not in stages
    assert "matching" not in stages
    unbroken = pretrain_grasping(TASK, tmp_path / "other.pt", 0, "cpu", silent, TINY, LAST)
    for name, value in unbroken.net.state_dict().items():
        assert torch.equal(resumed.net.state_dict()[name], value)
    assert resumed.card["resumed"]
    assert "interrupted and resumed" in output.with_suffix(".md").read_text()


def stop_in_meta(stage: str, *_: object) -> None:
    if stage == "meta":
        raise KeyboardInterrupt


def interrupted(output: Path) -> Path:
    """The partial of a pretraining with seed 0 that got through its second stage."""
    with pytest.raises(KeyboardInterrupt):
        pretrain_grasping(TASK, output, 0, "cpu", stop_in_meta, TINY, LAST)
    return output.with_name(output.name + ".partial")


def stages_until_meta(output: Path) -> set[str]:
    stages: set[str] = set()

    def watch(stage: str, *_: object) -> None:
        stages.add(stage)
        stop_in_meta(stage)

    with pytest.raises(KeyboardInterrupt):
        pretrain_grasping(TASK, output, 0, "cpu", watch, TINY, LAST)
    return stages


@pytest.mark.parametrize(
    "spoil",
    [
        lambda _: b"",
        lambda _: b"hello",
        lambda data: data[:-100],
        lambda data: data[: len(data) // 2] + b"spoilt" + data[len(data) // 2 + 6 :],
        lambda data: data[32:],  # without its digest
    ],
)
def test_a_damaged_partial_counts_as_none(tmp_path: Path, spoil: Callable[[bytes], bytes]) -> None:
    path = interrupted(tmp_path / "sgm.pt")
    assert "backbone" not in stages_until_meta(tmp_path / "sgm.pt")
    path.write_bytes(spoil(path.read_bytes()))
    assert "backbone" in stages_until_meta(tmp_path / "sgm.pt")


@pytest.mark.parametrize(
    "saved",
    [
        {},
        [1],
        {"identity": {"seed": 0}},
        {"identity": {"seed": 0}, "data": {}},
        {"identity": {"seed": 0}, "data": 3, "seconds": 1.0},
        {"identity": {"seed": 0}, "data": {}, "seconds": "x"},
        {"identity": {"seed": 0}, "data": {"net": 1}, "seconds": math.nan},
        {"identity": {"seed": torch.zeros(2)}, "data": {"net": 1}, "seconds": 1.0},
    ],
    ids=str,
)
def test_a_partial_with_a_right_digest_and_wrong_content_counts_as_none(
    tmp_path: Path, saved: object
) -> None:
    buffer = BytesIO()
    torch.save(saved, buffer)
    body = buffer.getvalue()
    (tmp_path / "x.partial").write_bytes(hashlib.sha256(body).digest() + body)
    taken_up = Partial.open(tmp_path / "x", {"seed": 0})
    assert not taken_up.resumed
    assert taken_up.seconds < 1


def test_a_folder_in_the_partials_place_is_said_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "sgm.pt.partial").mkdir()
    with pytest.raises(QsgmError, match="exists and is not a file"):
        pretrain_grasping(TASK, tmp_path / "sgm.pt", 0, "cpu", silent, TINY, LAST)


def test_a_partial_of_another_version_is_not_taken_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupted(tmp_path / "sgm.pt")
    monkeypatch.setattr("qsgm.__version__", "99.0")
    assert "backbone" in stages_until_meta(tmp_path / "sgm.pt")


def test_seconds_are_counted_over_interruptions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [1000.0]
    monkeypatch.setattr(partial_module, "perf_counter", lambda: clock[0])
    first = Partial.open(tmp_path / "x", {"seed": 0})
    clock[0] += 50
    first.save(net=1)
    clock[0] = 5.0  # another process, its clock started anew
    second = Partial.open(tmp_path / "x", {"seed": 0})
    clock[0] += 7
    assert second.seconds == 57
    assert Partial.open(tmp_path / "x", {"seed": 1}).seconds == 0


def test_the_command_on_the_card_says_every_option_that_is_not_the_default() -> None:
    plain = module._command(0, "cpu", PretrainConfig())
    assert plain == "qsgm pretrain -o sgm.pt --seed 0"
    other = module._command(3, "cuda", TINY)
    assert other == "qsgm pretrain -o sgm.pt --seed 3 --device cuda --hidden 8"


def test_angles_encoded_as_in_the_paper_are_learnt_and_the_card_says_so(tmp_path: Path) -> None:
    task = DrawnGrasping("paper")
    last = replace(LAST, task=task)
    made = pretrain_grasping(task, tmp_path / "sgm.pt", 0, "cpu", silent, TINY, last)
    assert made.card["command"] == "qsgm pretrain -o sgm.pt --seed 0 --hidden 8 --encoding paper"
    loaded = load_checkpoint(tmp_path / "sgm.pt").task
    assert grasp_task(loaded, "it").encoding == "paper"
    assert loaded.heads == task.heads


def test_the_card_says_where_the_backbone_was_trained(tmp_path: Path) -> None:
    partial = Partial.open(tmp_path / "x", {})
    score = Score(0.0, {"accuracy": 1.0})
    card = module._card("qsgm pretrain", "cuda", TINY, LAST.to_json(), score, partial)
    assert "backbone on cuda" in module._card_text(tmp_path / "x", card)


def test_a_backbone_that_blows_up_leaves_nothing(tmp_path: Path) -> None:
    config = replace(TINY, backbone=replace(TINY.backbone, peak_rate=1e30))
    with pytest.raises(QsgmError, match=r"stage `backbone`: ConvNet .* pass another --seed"):
        pretrain_grasping(TASK, tmp_path / "sgm.pt", 0, "cpu", silent, config, LAST)
    assert not list(tmp_path.iterdir())


def test_sgms_that_blow_up_leave_no_output(tmp_path: Path) -> None:
    config = replace(TINY, matching=replace(TINY.matching, peak_rate=1e30))
    with pytest.raises(QsgmError, match=r"stage `matching`: Sgm .* pass another --seed"):
        pretrain_grasping(TASK, tmp_path / "sgm.pt", 0, "cpu", silent, config, LAST)
    assert not (tmp_path / "sgm.pt").exists()


def test_meta_training_that_blows_up_leaves_no_output(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def blow_up(training: MetaTraining, _: object) -> None:
        torch.nn.init.constant_(training.start[0][0], float("inf"))

    monkeypatch.setattr(MetaTraining, "run", blow_up)
    with pytest.raises(QsgmError, match="stage `meta`: ConvNet"):
        pretrain_grasping(TASK, tmp_path / "sgm.pt", 0, "cpu", silent, TINY, LAST)
    assert not (tmp_path / "sgm.pt").exists()


def test_rates_that_all_diverge_leave_no_output(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rates_module, "RATE_GRID", (1e38,))
    config = replace(TINY, rates=replace(TINY.rates, epochs=3))
    with pytest.raises(QsgmError, match=r"trial runs .* diverged"):
        pretrain_grasping(TASK, tmp_path / "sgm.pt", 0, "cpu", silent, config, LAST)
    assert [path.name for path in tmp_path.iterdir()] == ["sgm.pt.partial"]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("sgm.md", "where the model card goes"),
        ("SGM.MD", "where the model card goes"),
        ("folder", "got a folder"),
        ("folder/..", "got a folder"),
        ("file/sgm.pt", "cannot write"),
        ("file/more/sgm.pt", "cannot write"),
        ("card.pt", "card.md: it is there and no file"),
        ("x" * 300, "cannot write"),
    ],
)
def test_a_place_that_cannot_be_written_to_is_refused_before_training(
    tmp_path: Path, name: str, message: str
) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "card.md").mkdir()
    (tmp_path / "file").write_text("")
    with pytest.raises(QsgmError, match=message) as caught:
        pretrain_grasping(
            TASK, tmp_path / name, 0, "cpu", lambda *_: pytest.fail("it was training"), TINY, LAST
        )
    assert "\n" not in str(caught.value)


def test_folders_on_the_way_to_the_output_are_made(tmp_path: Path) -> None:
    interrupted(tmp_path / "new/folder/sgm.pt")


def test_stages_after_the_backbone_run_on_one_thread_and_then_as_before(tmp_path: Path) -> None:
    threads: dict[str, int] = {}
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        pretrain_grasping(
            TASK,
            tmp_path / "sgm.pt",
            0,
            "cpu",
            lambda stage, *_: threads.update({stage: torch.get_num_threads()}),
            TINY,
            LAST,
        )
        after = torch.get_num_threads()
        with pytest.raises(KeyboardInterrupt):
            pretrain_grasping(TASK, tmp_path / "other.pt", 0, "cpu", stop_in_meta, TINY, LAST)
        after_interruption = torch.get_num_threads()
    finally:
        torch.set_num_threads(before)
    late = ("tasks", "matching", "meta", "early", "rates", "decision")
    assert threads == {"backbone": 2} | dict.fromkeys(late, 1)
    assert (after, after_interruption) == (2, 2)


def test_a_partial_of_another_seed_is_not_taken_up(tmp_path: Path) -> None:
    output = tmp_path / "sgm.pt"
    first = replace(TINY, maml=replace(TINY.maml, outer_steps=1))
    with pytest.raises(ZeroDivisionError):
        pretrain_grasping(
            TASK, output, 0, "cpu", lambda stage, *_: 1 // (stage != "meta"), first, LAST
        )
    stages: set[str] = set()
    pretrain_grasping(TASK, output, 1, "cpu", lambda stage, *_: stages.add(stage), first, LAST)
    assert "backbone" in stages


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_device_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(QsgmError, match="--device cpu"):
        pretrain_grasping(TASK, tmp_path / "sgm.pt", 0, "cuda", silent, TINY, LAST)
    assert not list(tmp_path.iterdir())
