"""A network of somebody's own goes the whole way, by the command line and from Python: the digits.

examples/digits in small: enough to beat chance by far.
"""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

import qsgm
from qsgm import (
    QsgmError,
    Samples,
    SampleTask,
    Settings,
    cli,
    learn,
    load_bundle,
    load_network,
    load_task,
    resolve,
)
from qsgm.task import heads_to_json
from qsgm.train import from_torch, load_checkpoint
from qsgm.train.pretraining.first_rates import candidates
from qsgm.train.pretraining.own_runs import OwnRunsConfig
from qsgm.train.pretraining.rates import EARLY_RATE_GRID
from qsgm.train.samples import build as building
from qsgm.train.samples.drawn import quicker, usual_config

EXAMPLES = Path(qsgm.__file__).parent.parent / "examples" / "digits"
FILE = EXAMPLES / "digits_task.py"


def small(task: SampleTask, **chosen: Any) -> Any:
    config = replace(quicker(usual_config(task, **chosen), 0.1), first_rates=(5e-3, 1e-1))
    early = replace(config.early, tasks=3, crops_per_task=40, epochs=2, looks=(1, 2))
    own = replace(config.own_runs, tasks=4, epochs=4)
    return replace(config, early=early, own_runs=own, rates=replace(config.rates, tasks=3))


def samples(path: Path, count: int = 250) -> Path:
    met = digits().met(np.random.default_rng(5), count)
    np.savez(path, samples=met.inputs, labels=met.labels)
    return path


def digits() -> Any:
    return load_task(FILE)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint and a bundle, as the command line makes them; where rates start is tried out."""

    def automatic(task: SampleTask, **chosen: Any) -> Any:
        return replace(small(task, **chosen), first_rates=2)

    folder = tmp_path_factory.mktemp("digits")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(building, "usual_config", automatic)
        usual = replace(building.USUAL, epochs=1)
        patch.setattr(building, "USUAL", usual)
        task = ["--task", str(FILE)]
        kept, bundle = str(folder / "mine.pt"), str(folder / "mine")
        assert cli.run(["pretrain", *task, "-o", kept]) == 0
        assert cli.run(["fold-and-quantize", kept, *task, "-o", bundle]) == 0
    return folder


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    capsys.readouterr()
    assert cli.run([str(one) for one in arguments]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    return err


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    capsys.readouterr()
    assert cli.run([*map(str, arguments)]) == 0
    return capsys.readouterr().out


def printed(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
    capsys.readouterr()
    assert cli.run([*map(str, arguments), "--json"]) == 0
    values: dict[str, Any] = json.loads(capsys.readouterr().out)
    return values


def test_a_task_file_is_short_and_needs_no_torch() -> None:
    assert len(FILE.read_text().splitlines()) <= 80
    code = f"import sys, qsgm, pathlib; qsgm.load_task(pathlib.Path({str(FILE)!r})); "
    code += "sys.exit(any(name in sys.modules for name in ('torch', 'onnx', 'sklearn')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_bundle_names_its_task_and_holds_no_code(made: Path) -> None:
    manifest = json.loads((made / "mine" / "manifest.json").read_text())
    assert manifest["task"] == {"name": "digits", "tuned": 2}
    assert not [one for one in (made / "mine").iterdir() if one.suffix == ".py"]


def test_where_rates_start_is_chosen_and_said(made: Path) -> None:
    card = load_checkpoint(made / "mine.pt").card
    assert tuple(card["config"]["first_rates"]) in {*candidates(2)}
    assert '"first_rates": [' in (made / "mine.md").read_text()


def test_the_command_line_tunes_and_answers_by_the_names_of_heads(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, tuned = samples(tmp_path / "hand.npz"), tmp_path / "tuned"
    told = ["--bundle", made / "mine", "--task", FILE, "--int8", "-o", tuned]
    report = printed(capsys, "finetune", *told, path)
    assert report["task"] == "digits"
    assert (report["layers"], report["epochs"]) == (2, 20)
    assert report["samples"] == {"taught": 200, "held_out": 50}
    before = report["zero_shot"]["digit_accuracy"]
    assert report["scores"]["digit_accuracy"] > before + 0.4
    assert report["fidelity"]["3"]["cos_int8_float"] > 0.999
    answers = printed(capsys, "predict", "--object", tuned, path)
    assert (answers["object"], answers["task"], answers["samples"]) == ("hand", "digits", 250)
    assert len(answers["outputs"]) == 250
    assert sum(answers["outputs"][0]["digit"]) == pytest.approx(1, abs=1e-3)
    assert "center_px" not in answers
    assert (
        answers["scores"]
        == printed(capsys, "predict", "--object", tuned, "--task", FILE, path)["scores"]
    )
    assert "--all concerns" in refused(capsys, "predict", "--object", tuned, "--all", path)
    assert "--output concerns" in refused(capsys, "predict", "-o", tmp_path / "a.png", path)
    assert cli.run(["predict", str(path)]) == 0  # the last one tuned
    assert "digit_accuracy" in capsys.readouterr().out
    two = ["predict", "--object", tuned, "--object", tuned, path]
    assert "answers alone" in refused(capsys, *two)


def test_among_objects_a_tuned_network_says_what_it_is(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = samples(tmp_path / "hand.npz")
    printed(capsys, "finetune", "--bundle", made / "mine", "--task", FILE, path)
    (listed,) = printed(capsys, "objects", "list")["objects"]
    said = {key: listed[key] for key in ("name", "task", "last", "problem", "patch", "scale")}
    assert said == {"name": "hand", "task": "digits", "last": True, "problem": None} | {
        "patch": False,
        "scale": None,
    }
    assert "(digits) *" in run(capsys, "objects", "list")
    shown = printed(capsys, "objects", "show", "hand")
    assert (shown["input_shape"], shown["input_kind"], shown["layers"]) == ([8, 8, 1], "pixels", 4)
    assert shown["made"]["seed"] == 0
    assert "cross_entropy, 10 channels, softmax" in run(capsys, "objects", "show", "hand")
    copied = printed(capsys, "objects", "export", "hand", "-o", tmp_path / "hand.onnx")
    assert copied["heads"] == shown["heads"] == heads_to_json(digits().heads)
    assert (tmp_path / "hand.onnx").read_bytes() == (
        Path(listed["folder"]) / "network.onnx"
    ).read_bytes()
    printed(capsys, "objects", "rename", "hand", "mine")
    assert printed(capsys, "predict", "--object", "mine", path)["object"] == "mine"
    assert "pass `qsgm predict` its samples" in refused(capsys, "watch", tmp_path)
    printed(capsys, "objects", "rename", "mine", "hand")
    assert printed(capsys, "predict", "--object", "hand", path)["object"] == "hand"
    assert printed(capsys, "objects", "remove", "hand", "--yes")["removed"] == listed["folder"]


def test_gradients_can_be_compared_along_one_run(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = ["--bundle", made / "mine", "--task", FILE]
    path = samples(tmp_path / "hand.npz", 100)
    values = printed(capsys, "fidelity", *own, "--every", 20, path)
    assert (values["layers"], [*values["fidelity"]]) == (2, ["3"])
    assert [one["step"] for one in values["fidelity_over_run"]] == [0, 20, 40, 60]
    every = printed(capsys, "fidelity", *own, "--layers", 4, "--epochs", 1, path)
    assert [*every["fidelity"]] == ["1", "3"]
    assert "--center concerns" in refused(capsys, "fidelity", *own, "--center", "1,1", path)
    (tmp_path / "one.py").write_text(FILE.read_text().replace("(DIGIT,))", "(DIGIT,), tuned=1)"))
    one = ["--bundle", made / "mine", "--task", tmp_path / "one.py"]
    nothing = tmp_path / "no_samples.npz"  # it is not even read
    assert "one layer has no SGM" in refused(capsys, "fidelity", *one, nothing)
    assert "pass --task FILE.py" in refused(capsys, "fidelity", *own[:2], path)
    assert "choose 1 to 4" in refused(capsys, "finetune", *own, "--layers", 7, path)


def test_a_device_tunes_layers_in_the_groups_that_pay_unless_told_otherwise(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bundle = load_bundle(made / "mine")
    usual, rates = bundle.manifest.usual_blocks, load_checkpoint(made / "mine.pt").rates
    assert usual == {2: "3,4", 3: "2-3,4", 4: "1,2-3,4"}
    for tuned, text in usual.items():
        plan = resolve(Settings(layers=tuned), bundle)
        assert str(plan.blocks) == text
        assert resolve(Settings(layers=tuned, optimizer="sgd"), bundle).recipe.rates == rates[text]
        early = {*rates[text][:-2]}
        assert len(early) == (tuned > 2)  # one for all that were not meta-trained
        assert early <= {*EARLY_RATE_GRID}
        assert rates[text][-2:] == rates["3,4"]
        if tuned > 2:
            assert plan.recipe.optimizer == "sgd"
    assert str(resolve(Settings(layers=4, optimizer="adam"), bundle).blocks) == "1,2,3,4"
    assert str(resolve(Settings(layers=4, blocks="1,2,3,4"), bundle).blocks) == "1,2,3,4"
    assert str(resolve(Settings(layers=4, method="bp"), bundle).blocks) == "1-4"
    own, path = ["--task", FILE], samples(tmp_path / "hand.npz", 60)
    printed(capsys, "slim", "--bundle", made / "mine", "--blocks", usual[4], "-o", tmp_path / "s")
    told = [*own, "--layers", 4, "--epochs", 2, "-o", tmp_path / "tuned", path]
    whole = printed(capsys, "finetune", "--bundle", made / "mine", *told)
    assert whole["blocks"] == usual[4]
    slim = printed(capsys, "finetune", "--bundle", tmp_path / "s", *told)
    assert [slim[key] for key in ("blocks", "scores", "rates")] == [
        whole[key] for key in ("blocks", "scores", "rates")
    ]
    assert "blocks 1,2-3,4" in run(capsys, "finetune", "--bundle", tmp_path / "s", *told)


def with_usual(bundle: Path, folder: Path, optimizer: str) -> Path:
    """The bundle with another usual optimizer for two layers."""
    copied = Path(shutil.copytree(bundle, folder))
    manifest = json.loads((copied / "manifest.json").read_text())
    manifest["recipes"]["sgm"]["optimizers"] = {"3,4": optimizer}
    (copied / "manifest.json").write_text(json.dumps(manifest))
    return copied


def test_rates_were_tried_out_at_the_lengths_of_a_devices_runs(made: Path) -> None:
    bundle, kept = load_bundle(made / "mine"), load_checkpoint(made / "mine.pt")
    assert [*kept.recipes] == ["4", "3,4"]
    for text, recipes in kept.recipes.items():
        layers = bundle.network.last(len(text.split(",")))
        assert bundle.recipe("sgm", layers, None) == recipes[0]
        for one in recipes:
            assert bundle.recipe("sgm", layers, one.optimizer) == one
            assert [steps for steps, _ in one.gains] == [5, 15, 100]  # of 160 samples
            assert one.rates_over(100) == pytest.approx(one.rates)
    sgd = next(one for one in kept.recipes["3,4"] if one.optimizer == "sgd")
    # More layers than were meta-trained run as long: they take the gains of those that were.
    deep = resolve(Settings(layers=4), bundle).recipe
    assert (deep.optimizer, deep.gains) == ("sgd", sgd.gains)


@pytest.mark.parametrize("optimizer", ["sgd", "adam"])
def test_a_slim_bundle_runs_by_the_optimizer_that_is_usual(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], optimizer: str
) -> None:
    whole, slim = with_usual(made / "mine", tmp_path / "whole", optimizer), tmp_path / "slim"
    printed(capsys, "slim", "--bundle", whole, "--blocks", "3,4", "-o", slim)
    steps = {path.name for path in slim.glob("step_*_3,4.onnx")}
    assert steps == {f"step_{one}_{optimizer}_3,4.onnx" for one in ("int8", "float")}
    told = ["--task", FILE, "--int8", "--epochs", 3, "-o", tmp_path / "tuned"]
    told.append(samples(tmp_path / "hand.npz", 100))
    reports = [printed(capsys, "finetune", "--bundle", one, *told) for one in (whole, slim)]
    assert reports[0]["optimizer"] == reports[1]["optimizer"] == optimizer
    for key in ("scores", "rates", "fidelity"):
        assert reports[0][key] == reports[1][key]
    recipe = load_bundle(slim).recipe("sgm", range(3, 5), None)
    said = (slim / "bundle.txt").read_text().splitlines()
    pairs = " ".join(f"{steps} {factor}" for steps, factor in recipe.gains)
    assert f"gains {pairs}" in said
    assert (f"optimizer {optimizer}" in said) == (optimizer == "adam")
    slim_again = tmp_path / "again"
    printed(capsys, "slim", "--bundle", slim, "--blocks", "3,4", "-o", slim_again)
    for path in slim.iterdir():
        assert (slim_again / path.name).read_bytes() == path.read_bytes()


def test_a_run_that_ends_worse_than_it_began_says_so(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = made / "mine" / "manifest.json"
    bad = Path(shutil.copytree(made / "mine", tmp_path / "bad")) / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["recipes"]["sgm"]["rates"]["sgd"]["3,4"] = [1.0, 1.0]
    manifest["recipes"]["sgm"]["optimizers"] = {}
    bad.write_text(json.dumps(manifest))
    met = digits().met(np.random.default_rng(5), 250, own_meanings=False)
    np.savez(tmp_path / "hand.npz", samples=met.inputs, labels=met.labels)
    told = ["--task", FILE, "--epochs", 3, "-o", tmp_path / "tuned", tmp_path / "hand.npz"]
    report = printed(capsys, "finetune", "--bundle", bad.parent, *told)
    before, after = (report[key]["digit_accuracy"] for key in ("zero_shot", "scores"))
    assert after < before
    (line,) = report["warnings"]
    assert f"digit_accuracy {before:.3f} before, {after:.3f} now" in line
    shown = run(capsys, "finetune", "--bundle", bad.parent, *told)
    assert "note: tuning made it worse: held-out digit_accuracy" in " ".join(shown.split())
    nothing = printed(capsys, "finetune", "--bundle", bad.parent, *told, "--epochs", 0)
    assert nothing["warnings"] == []


def test_what_benchmarks_count_is_counted_of_any_network(
    made: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values = printed(capsys, "bench", "resources", "--repeats", 1, "--bundle", made / "mine")
    assert (values["paper"], [*values["layers"]]) == ({}, ["1", "2", "3", "4"])
    assert "Table 3" not in run(
        capsys, "bench", "resources", "--repeats", 1, "--bundle", made / "mine"
    )
    assert "expected 'grasp'" in refused(capsys, "bench", "accuracy", "--bundle", made / "mine")


def test_without_its_task_a_bundle_is_refused_in_one_line(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], bundle_folder: Path
) -> None:
    path, own = samples(tmp_path / "hand.npz"), ["--bundle", made / "mine"]
    assert "pass --task FILE.py" in refused(capsys, "finetune", *own, path)
    task = ["--task", FILE]
    assert "'grasp'" in refused(capsys, "finetune", "--bundle", bundle_folder, *task, path)
    assert "--center concerns" in refused(capsys, "finetune", *own, *task, "--center", "1,1", path)
    assert "or --task FILE.py" in refused(capsys, "fold-and-quantize", made / "mine.pt")
    assert "--encoding concerns" in refused(capsys, "pretrain", *task, "--encoding", "paper")
    assert not (Path(path).parent / "data").exists()


def test_the_built_in_task_takes_a_bundle_of_arrays_without_a_file(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bundle = Path(shutil.copytree(made / "mine", tmp_path / "arrays"))
    text = (bundle / "manifest.json").read_text()
    (bundle / "manifest.json").write_text(text.replace('"digits"', '"arrays"'))
    path = samples(tmp_path / "hand.npz")
    told = ["--bundle", bundle, "-o", tmp_path / "tuned"]
    report = printed(capsys, "finetune", *told, path)
    assert report["scores"]["digit_accuracy"] > 0.6


def test_three_lines_on_a_device_do_as_the_command_line(made: Path, tmp_path: Path) -> None:
    task, bundle = digits(), load_bundle(made / "mine")
    result = learn(task.read(samples(tmp_path / "hand.npz")), bundle, task)
    assert (len(result.plan.layers), result.plan.epochs) == (2, 20)
    result.save(tmp_path / "tuned", "hand")
    asked = task.met(np.random.default_rng(5), 20)
    again = load_network(tmp_path / "tuned").answers(asked.inputs)
    np.testing.assert_array_equal(again, result.tuned_network().answers(asked.inputs))
    with pytest.raises(QsgmError, match="samples are float32"):
        result.tuned_network().answers(asked.inputs.astype(np.float32))


@pytest.mark.parametrize(
    ("key", "value"), [("heads", []), ("network", {}), ("task", {"name": 3}), ("sha256", "0")]
)
def test_a_damaged_tuned_network_is_refused(
    made: Path, tmp_path: Path, key: str, value: object
) -> None:
    task = digits()
    learn(task.read(samples(tmp_path / "hand.npz", 40)), load_bundle(made / "mine"), task).save(
        tmp_path / "tuned", "hand"
    )
    path = tmp_path / "tuned" / "object.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    with pytest.raises(QsgmError) as caught:
        load_network(tmp_path / "tuned")
    assert "\n" not in str(caught.value)


def test_a_trained_network_is_taken_as_it_is(tmp_path: Path) -> None:
    torch.manual_seed(0)
    module = nn.Sequential(
        nn.Conv2d(1, 8, 3, padding=1), nn.ReLU(), nn.AvgPool2d(2), nn.Flatten(), nn.Linear(128, 10)
    )
    net = from_torch(module, (8, 8, 1), "pixels")
    start = {name: value.clone() for name, value in net.state_dict().items()}
    task = type(digits())("digits", net.network, digits().heads)
    config = replace(small(task), by_length=False, own_runs=OwnRunsConfig())
    options = building.ExportOptions(epochs=1)
    building.build(task, tmp_path / "own", net, config=config, options=options)
    assert all(torch.equal(value, start[name]) for name, value in net.state_dict().items())
    assert load_bundle(tmp_path / "own").network == net.network
    assert (tmp_path / "own.pt").is_file()
    with pytest.raises(QsgmError, match="is not the one of the task"):
        building.build(digits(), tmp_path / "other", net, config=config)


def test_a_task_that_draws_what_does_not_fit_is_refused_before_any_work(tmp_path: Path) -> None:
    class Short(type(digits())):  # type: ignore[misc]
        def example(self, rng: np.random.Generator, count: int) -> Samples:
            drawn: Samples = self.draw(rng, count - 1)
            return drawn

    task = Short("short", digits().network, digits().heads)
    with pytest.raises(QsgmError, match=r"`example` of the task 'short' gives 23 samples"):
        building.build(task, tmp_path / "own")
    assert not (tmp_path / "own").exists()


def test_an_array_of_samples_is_pretrained_on_as_a_json_file_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    samples(tmp_path / "pool.npz", 30)
    task, seen = digits(), list[Any]()
    about = {"network": task.network.to_json(), "heads": heads_to_json(task.heads)}
    (tmp_path / "pool.json").write_text(json.dumps(about | {"samples": "pool.npz"}))
    made = SimpleNamespace(card={"config": {"first_rates": [0.1]}}, rates={"4": (0.2,)}, recipes={})
    monkeypatch.setattr(building, "pretrain_samples", lambda *given: seen.append(given) or made)
    arguments = ["pretrain", "--task", str(tmp_path / "pool.json"), "--hidden", "8", "--json"]
    assert cli.run([*arguments, "-o", str(tmp_path / "mine.pt")]) == 0
    taken, config = seen[0][0], seen[0][5]
    assert (taken.name, taken.network, taken.heads) == ("arrays", task.network, task.heads)
    assert config.hidden == (8,)
    assert len(taken.draw(np.random.default_rng(0), 50)) == 50
