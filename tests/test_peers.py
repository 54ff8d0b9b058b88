"""Other frameworks' steps: the same job to the last digits, and a line for what is not there."""

import ast
import importlib.util
import io
import json
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
import pytest
import torch
from rich.console import Console

from qsgm import QsgmError, cli
from qsgm.bench import peers_table
from qsgm.bench.peers import PEERS, SCRIPTS, Peer, run_peer, write_job
from qsgm.bench.peers_table import (
    StepPlan,
    StepTimes,
    key_of,
    measure_steps,
    render_steps,
    steps_json,
)
from qsgm.bench.speed import peer_ratios
from qsgm.bundle import Bundle
from qsgm.images import read_demonstration
from qsgm.train.model.graspnet import Loss
from qsgm.train.peers import step_data as job
from qsgm.train.peers.ort_training_steps import loss_model, weight_names
from qsgm.train.peers.torch_steps import ExportedNet, Net, eager_step, timed_steps
from qsgm.tune.prepare import prepare
from qsgm.tune.settings import Settings
from qsgm.weights import to_step_layout

STEPS = job.CHECKED_STEPS + 5
FAKE = Peer("fake", ("torch_steps.py",), "losses", "fake")
ENCODINGS = ("double", "paper")


@pytest.fixture(scope="module")
def data(frames_folder: Path, bundle: Bundle) -> dict[str, Any]:
    return job.step_data(read_demonstration(frames_folder / "bar.png"), bundle, 3, STEPS)


@pytest.fixture(scope="module")
def data_file(data: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("job") / "job.npz"
    np.savez(path, **data)
    return path


def fake_python(folder: Path, body: str) -> Path:
    """Something that runs like a Python and does what the body says."""
    path = folder / "fake_python"
    path.write_text(f"#!{sys.executable}\nimport json, os, sys, time\nimport numpy as np\n{body}\n")
    path.chmod(0o755)
    return path


def printing(losses: str) -> str:
    """The body of a peer whose losses are those given by an expression of the job's `data`."""
    return f"""
path, threads, seconds = sys.argv[-3:]
data = np.load(path)
print("something that a library says")
print(json.dumps({{
    "version": "1", "optimizer": "SGD", "imported_at": time.time(), "setup_seconds": 2.0,
    "steps": 3, "step_seconds": 0.001 * int(threads), "total_seconds": 0.003,
    "losses": ({losses}).tolist(),
}}))"""


@pytest.mark.parametrize("layers", [1, 3, 4, 6])
def test_a_torch_step_does_what_a_backpropagation_step_here_does(
    frame_path: Path, bundle: Bundle, layers: int
) -> None:
    frame = read_demonstration(frame_path)
    given = job.step_data(frame, bundle, layers, STEPS)
    losses, times = timed_steps(eager_step(given, 1), given, 1e9)
    assert len(losses) == len(times) == STEPS
    np.testing.assert_allclose(losses[: job.CHECKED_STEPS], given["losses"], rtol=1e-4)
    # And weight by weight, after a few steps.
    settings = Settings(method="bp", layers=layers, trunk="float")
    prepared = prepare(frame, bundle, settings)
    loop = job.own_loop(prepared, prepared.start)
    net = Net(given)
    optimizer = torch.optim.SGD(net.parameters(), lr=job.RATE, momentum=job.MOMENTUM)
    features, labels = (torch.from_numpy(given[name]) for name in ("features", "labels"))
    for rows in given["rows"][:5]:
        loop.step(rows)
        optimizer.zero_grad()
        net(features[rows], labels[rows]).backward()
        optimizer.step()
    own = loop.weights()
    for number, conv in zip(given["layers"], net.convolutions, strict=True):
        weight = to_step_layout(conv.weight.detach().numpy())
        np.testing.assert_allclose(own[f"weight{number}"], weight, atol=1e-5)
        np.testing.assert_allclose(own[f"bias{number}"], conv.bias.detach().numpy(), atol=1e-5)


def test_losses_without_momentum_are_those_of_plain_sgd(data: dict[str, Any]) -> None:
    plain = {**data, "momentum": np.float32(0)}
    losses, _ = timed_steps(eager_step(plain, 1), plain, 1e9)
    np.testing.assert_allclose(losses[: job.CHECKED_STEPS], data["plain_losses"], rtol=1e-4)
    assert np.abs(data["losses"] - data["plain_losses"]).max() > 1e-3


def test_every_crop_is_in_one_batch_of_each_epoch(data: dict[str, Any]) -> None:
    assert data["rows"].shape == (STEPS, 32)
    epoch = job.CROPS // 32
    for first in range(0, STEPS - epoch, epoch):
        seen = data["rows"][first : first + epoch].ravel()
        np.testing.assert_array_equal(np.sort(seen), np.arange(job.CROPS))


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_form_of_the_loss_and_its_gradient_is_the_networks_own(
    data: dict[str, Any], encoding: str
) -> None:
    given = {**data, "encoding": np.array(encoding)}
    net, exported = Net(given), ExportedNet(given)
    x, labels = (torch.from_numpy(data[name][data["rows"][0]]) for name in ("features", "labels"))
    raw = torch.randn(32, 3, generator=torch.Generator().manual_seed(0)) * 4
    own = Loss(encoding, float(data["smoothing"]))  # type: ignore[arg-type]
    torch.testing.assert_close(net.loss(raw, labels), own(raw, labels))
    losses = [some(x, labels) for some in (net, exported)]
    torch.testing.assert_close(*losses)
    gradients = [
        torch.autograd.grad(loss, [*some.parameters()])
        for loss, some in zip(losses, (net, exported), strict=True)
    ]
    torch.testing.assert_close(*gradients)
    model = loss_model(given)
    session = ort.InferenceSession(model.SerializeToString())
    (found,) = session.run(None, {"features": x.numpy(), "labels": labels.numpy()})
    assert found == pytest.approx(losses[0].item(), rel=1e-5)
    assert {value.name for value in model.graph.initializer} > set(weight_names(given))


def test_steps_that_take_long_are_fewer(data: dict[str, Any]) -> None:
    def slow(*_: torch.Tensor) -> float:
        time.sleep(1e-3)
        return 0.0

    many = {**data, "rows": data["rows"].repeat(4, axis=0)}
    losses, _ = timed_steps(slow, many, 0.0)
    assert len(losses) == job.CHECKED_STEPS + 5 < len(many["rows"])


@pytest.mark.parametrize("script", ["torch_steps.py", "ort_training_steps.py"])
def test_jobs_for_other_pythons_import_nothing_of_this_package(script: str) -> None:
    tree = ast.parse((SCRIPTS / script).read_text())
    modules = {
        name
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in (
            [node.module] if isinstance(node, ast.ImportFrom) else [one.name for one in node.names]
        )
    }
    assert "numpy" in modules
    assert not [name for name in modules if name and name.partition(".")[0] == "qsgm"]
    # A script's own folder comes first in the search path: none may hide what it imports.
    assert not [path.stem for path in SCRIPTS.glob("*.py") if importlib.util.find_spec(path.stem)]


def test_torch_itself_is_run_and_read(frame_path: Path, bundle: Bundle, tmp_path: Path) -> None:
    write_job(frame_path, bundle.folder, 1, tmp_path / "job.npz")
    run = run_peer(PEERS[0], {}, tmp_path / "job.npz", 1, tmp_path)
    assert run.steps == 400
    assert run.loss_difference < 1e-4
    assert run.version == torch.__version__
    assert run.optimizer == "SGD, momentum 0.9"
    assert 0 < run.step_seconds < run.total_seconds
    assert run.import_seconds > 0


def test_a_peers_python_gets_none_of_this_ones_packages(
    data_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", "/somewhere")
    body = 'assert "PYTHONPATH" not in os.environ' + printing("data['losses']")
    run = run_peer(FAKE, {"fake": fake_python(tmp_path, body)}, data_file, 2, tmp_path)
    assert (run.steps, run.step_seconds, run.loss_difference) == (3, 0.002, 0)


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ("import a_module_that_is_not_there", "No module named 'a_module_that_is_not_there'"),
        ("sys.exit(3)", "exit code 3"),
        ("sys.exit('a.b.SomeError: it broke\\n\\nTurn on some log')", "^a.b.SomeError: it broke$"),
        ("sys.exit('Illegal instruction')", "^Illegal instruction$"),
        ("pass", "printed no result"),
        ("print('what a library says')", "printed no result"),
        ("print(json.dumps({'losses': [1.0]}))", "printed no result"),
        (printing("data['losses'] * 1.1"), "another job: its losses differ by 10 %"),
        (printing("data['losses'] * np.nan"), "another job: its losses differ by nan %"),
        (printing("data['losses'][:3]"), "printed no result"),
    ],
)
def test_a_peer_that_fails_says_why(
    data_file: Path, tmp_path: Path, body: str, reason: str
) -> None:
    with pytest.raises(QsgmError, match=reason):
        run_peer(FAKE, {"fake": fake_python(tmp_path, body)}, data_file, 1, tmp_path)


def test_a_peer_without_a_python_says_how_to_install_it(data_file: Path, tmp_path: Path) -> None:
    with pytest.raises(QsgmError, match=r"pip install executorch torch.*--peer executorch="):
        run_peer(PEERS[3], {}, data_file, 1, tmp_path)
    with pytest.raises(QsgmError, match="cannot run /nowhere/python: No such file"):
        run_peer(PEERS[3], {"executorch": Path("/nowhere/python")}, data_file, 1, tmp_path)


def measured(
    frame: Path, bundle: Bundle, python: Path, monkeypatch: pytest.MonkeyPatch, data_file: Path
) -> StepTimes:
    """Two repeats of one peer that is there and of others that are not."""
    monkeypatch.setattr(peers_table, "TURNS", 3)
    monkeypatch.setattr(
        peers_table, "write_job", lambda *to: Path(to[-1]).write_bytes(data_file.read_bytes())
    )
    peers = replace(PEERS[0], install="fake"), *PEERS[2:]
    plan = StepPlan((1, 2), {peers[0].name: python}, peers)
    return measure_steps(frame, bundle, 3, 1, 2, plan, lambda *_: None)


def test_what_is_missing_is_said_and_the_rest_measured(
    frame_path: Path,
    bundle: Bundle,
    data_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    python = fake_python(tmp_path, printing("data['losses']"))
    times = measured(frame_path, bundle, python, monkeypatch, data_file)
    report = steps_json(times)
    json.dumps(report, allow_nan=False)
    assert list(report["step_table_ms"]) == ["1", "2"]
    own = {"forward", "backprop", "sgm_float", "sgm_int8"}
    for threads, steps in report["step_table_ms"].items():
        assert set(steps) == own | {"torch_eager"}
        assert steps["torch_eager"] == int(threads)
        ratio = report["step_over_qsgm_step"][threads]["torch_eager"]
        assert ratio == pytest.approx(int(threads) / steps["sgm_float"], rel=1e-3)
        assert report["peers"][threads]["torch_eager"]["processes"] == 2
        assert report["peers"][threads]["torch_eager"]["setup_again_seconds"] == 2
    assert set(report["not_measured"]) == {"onnxruntime-training", "executorch"}
    assert list(peer_ratios(times, 1)) == ["torch_eager_step_over_qsgm_step"]
    text = shown(report)
    lines = text.splitlines()
    assert max(len(line.rstrip()) for line in lines) <= 80
    assert [line.split()[0] for line in lines if "eager" in line] == ["torch"]
    assert "executorch is not measured: no Python was given" in text


def test_a_peer_that_failed_once_is_not_run_again_nor_reported(
    frame_path: Path,
    bundle: Bundle,
    data_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    marks = tmp_path / "marks"
    marks.mkdir()
    body = f"open(f'{marks}/{{time.time_ns()}}', 'w')"
    # It fails with two threads only: what it gave with one is no longer worth a column.
    body += "\nassert sys.argv[-2] == '1', 'one thread only'" + printing("data['losses']")
    python = fake_python(tmp_path, body)
    times = measured(frame_path, bundle, python, monkeypatch, data_file)
    assert len(list(marks.iterdir())) == 2
    assert times.not_measured["torch eager"] == "AssertionError: one thread only"
    assert times.peers == {1: {}, 2: {}}


def test_without_data_no_peer_is_measured_and_own_steps_are(
    bundle: Bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(peers_table, "TURNS", 3)
    plan = StepPlan((1,))
    times = measure_steps(tmp_path / "none.png", bundle, 1, 2, 1, plan, lambda *_: None)
    assert set(times.own) == {1, 2}
    assert set(times.not_measured) == {peer.name for peer in PEERS}
    assert all("its data could not be made" in why for why in times.not_measured.values())


def test_the_table_of_all_peers_fits_into_80_columns() -> None:
    names = {key_of(peer.name): 123.4567 for peer in PEERS}
    own = {"forward": 0.2345, "sgm_int8": 1.2345, "sgm_float": 1.0, "backprop": 1.0}
    once: Mapping[str, Any] = {"import_seconds": 12.34, "setup_seconds": 123.45}
    report = {
        "step_table_ms": {"1": own | names, "2": own | names},
        "step_over_qsgm_step": {"1": own | names, "2": own | names},
        "peers": {"1": dict.fromkeys(names, once), "2": {}},
        "not_measured": {},
    }
    lines = [line.rstrip() for line in shown(report).splitlines()]
    assert max(map(len, lines)) <= 80
    rows = [line.strip().removeprefix("torch ").split() for line in lines]
    (row,) = (cells for cells in rows if cells[:1] == ["onnxruntime-training"])
    assert row == [
        "onnxruntime-training",
        "123.457",
        "123.46",
        "123.457",
        "123.46",
        "12.3",
        "123.5",
    ]


def shown(report: Mapping[str, Any]) -> str:
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(render_steps(report))
    return console.export_text()


@pytest.mark.parametrize(
    "options",
    [
        ("--peer", "tensorflow=/usr/bin/python"),
        ("--peer", "executorch"),
        ("--peer", "executorch="),
        ("--peer", "torch eager=/usr/bin/python"),
        ("--thread-counts", "0"),
        ("--thread-counts", "1;2"),
    ],
)
def test_peers_and_thread_counts_that_are_none_are_refused(
    frames_folder: Path, options: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(["bench", "speed", "--frames", str(frames_folder), *options]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert options[0] in message


def test_speed_takes_peers_and_thread_counts_from_the_command_line(
    frames_folder: Path,
    bundle_folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    plans: list[StepPlan] = []

    def record(*given: Any) -> StepTimes:
        plans.append(given[5])
        return StepTimes({1: dict.fromkeys(("forward", "backprop", "sgm_float", "sgm_int8"), 1.0)})

    monkeypatch.setattr("qsgm.bench.speed.measure_steps", record)
    stages = dict.fromkeys(("crops", "features", "tuning", "total", "process"), 1.0)
    monkeypatch.setattr("qsgm.bench.speed.run_once", lambda *_: stages)
    command = ["bench", "speed", "--frames", str(frames_folder), "--bundle", str(bundle_folder)]
    command += ["--peer", "executorch=/et/python", "--thread-counts", "1,3", "--repeats", "1"]
    assert cli.run(command) == 0
    assert plans[0].thread_counts == (1, 3)
    assert plans[0].interpreters == {"executorch": Path("/et/python")}
    assert "a training step" in capsys.readouterr().out
