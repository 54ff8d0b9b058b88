"""Scripts beside the package run, and say what they should."""

import ast
import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import onnxruntime as ort
import pytest
import torch
from toys import lay, table, toy

from qsgm import Settings, finetune
from qsgm.bench.frames import list_frames
from qsgm.bundle import Bundle
from qsgm.grasp.task import GraspTask
from qsgm.images import read_demonstration
from qsgm.train.heads import mean_loss

SCRIPTS = Path(__file__).parents[1] / "benchmarks"
PEERS = SCRIPTS / "peers"


def told(tmp_path: Path, script: str, *arguments: object) -> tuple[str, Any]:
    """What a script prints, and the JSON that it writes."""
    path = tmp_path / "told.json"
    command = [sys.executable, SCRIPTS / script, *arguments, "--json", path]
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout, json.loads(path.read_text())


def test_sizes_of_drawn_objects_are_measured_at_every_share(tmp_path: Path) -> None:
    _, found = told(tmp_path, "spans.py", "--objects", 2)
    assert list(found) == [f"drawn, {share}%" for share in (10, 20, 35, 50, 70, 85)]
    assert all(count == 2 for _, count in found.values())
    assert sum(right for right, _ in found.values()) >= 9


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    """Two objects, each photographed twice, and something else."""
    objects = []
    for number, picture in enumerate((toy(), toy()[..., [1, 2, 0, 3]])):
        photos = []
        for k, center in enumerate(((160.0, 120.0), (150.0, 140.0))):
            file = f"{number}_{k}.png"
            scene = lay(picture, table(k, (240, 320)), center, 30 * k)
            cv2.imwrite(str(tmp_path / file), scene)
            photos.append(
                {"file": file, "center_px": center, "long_side_px": 90, "turn_deg": 30 * k}
            )
        objects.append({"object": f"toy_{number}", "photos": photos})
    cv2.imwrite(str(tmp_path / "nothing.png"), table(7, (240, 320)))
    (tmp_path / "manifest.json").write_text(json.dumps(objects))
    (tmp_path / "negatives.json").write_text(json.dumps(["nothing.png"]))
    return tmp_path


def test_photographs_are_counted_with_the_object_and_without_it(
    photographs: Path, tmp_path: Path
) -> None:
    bundle = SCRIPTS.parent / "export"
    printed, values = told(
        tmp_path, "photographs.py", photographs, "--bundle", bundle, "--others", 3
    )
    assert "found in the right place" in printed
    assert values["refused"] == []
    present = [one for one in values["answers"] if one["present"]]
    absent = [one for one in values["answers"] if not one["present"]]
    assert (len(present), len(absent)) == (2, 2 * (2 + 1))
    for one in present:
        assert one["right"]
        assert one["turn_error_deg"] < 2
    assert not any(one["found"] for one in absent if one["file"] == "nothing.png")


def test_layers_are_compared_division_by_division(
    frames_folder: Path, bundle_folder: Path, tmp_path: Path
) -> None:
    asked = ("--frames", frames_folder, "--bundle", bundle_folder, "--epochs", 1)
    printed, values = told(tmp_path, "layers.py", *asked, "--blocks", "4,5,6", "--blocks", "4,5-6")
    assert "4,5-6" in printed
    assert list(values["blocks"]) == ["4,5,6", "4,5-6"]
    for row in values["blocks"].values():
        mean = np.mean(row["per_frame"], axis=0)
        assert row["detection_accuracy"] == pytest.approx(mean[0], abs=1e-3)
        assert row["angle_mae_deg"] == pytest.approx(mean[1], abs=1e-3)


def test_a_run_in_which_nothing_sits_out_is_the_usual_one(
    frames_folder: Path, bundle: Bundle, bundle_folder: Path, tmp_path: Path
) -> None:
    asked = ("--frames", frames_folder, "--bundle", bundle_folder, "--epochs", 2, "--limit", 1)
    printed, values = told(tmp_path, "sitting_out.py", *asked)
    assert "backpropagation, 2 epochs, half sits out" in printed
    frame = read_demonstration(list_frames(frames_folder, 1)[0].path)
    usual = finetune(frame, bundle, Settings(epochs=2)).scores
    shown = {name: usual[name] for name in ("detection_accuracy", "angle_mae_deg")}
    assert values["SGMs, 2 epochs, all"] == pytest.approx(shown, abs=1e-4)
    assert values["SGMs, 2 epochs, half sits out"] != values["SGMs, 2 epochs, all"]


def test_every_baseline_runs(frames_folder: Path, tmp_path: Path) -> None:
    asked = ("--frames", frames_folder, "--layers", 2, "--epochs", 1, "--limit", 1)
    printed, values = told(tmp_path, "baselines.py", SCRIPTS.parent / "sgm.pt", *asked)
    assert "target projection" in printed
    assert len(values["systems"]) == 10
    for figures in values["systems"].values():
        assert 0 <= figures["detection_accuracy"] <= 1


def test_growth_times_every_size_and_draws(
    frames_folder: Path, bundle_folder: Path, tmp_path: Path
) -> None:
    picture = tmp_path / "growth.png"
    asked = ("--frames", frames_folder, "--bundle", bundle_folder, "--picture", picture)
    sizes = ("--batches", "2,4", "--layers", "1,2", "--widths", "1,2", "--crops", "20,40")
    few = ("--repeats", 1, "--epochs", 1)
    printed, values = told(tmp_path, "growth", *asked, *sizes, *few)
    assert max(map(len, printed.splitlines())) <= 80
    steps, alone = {"forward", "backprop", "sgm_float", "sgm_int8"}, {"float"}
    eight = {"int8_8_u8", "int8_8_s8"}
    for name, some, variants in (
        ("batch", {"2", "4"}, steps),
        ("layers", {"1", "2"}, steps),
        ("width", {"1", "2"}, steps | {"sgm_float_wider", "sgm_int8_wider"}),
        ("crops", {"20", "40"}, steps - {"forward"} | {"crops", "features"}),
        ("trunk", {"1", "2"}, alone | eight),
        ("sgm_1x1", {"1", "2"}, alone | eight | {"int8_16_u8", "int8_16_s8"}),
        ("sgm_3x3", {"1", "2"}, alone | eight | {"int8_16_u8", "int8_16_s8"}),
    ):
        assert set(values["ms"][name]) == some
        assert all(set(ms) == variants for ms in values["ms"][name].values())
    assert values["where_int8_wins"].startswith("int8 saves 5%")
    assert cv2.imread(str(picture)) is not None


def test_depth_compares_steps_with_backpropagations_and_draws(tmp_path: Path) -> None:
    picture = tmp_path / "depth.png"
    printed, values = told(
        tmp_path, "depth.py", "--depths", "3,5", "--repeats", 1, "--picture", picture
    )
    assert max(map(len, printed.splitlines())) <= 80
    for by_depth in values["networks"].values():
        assert [*by_depth] == ["3", "5"]
        grown = {name: by_depth["5"]["steps"][name]["peak_bytes"] for name in ("backprop", "alone")}
        first = by_depth["3"]["steps"]["alone"]["peak_bytes"]
        assert grown["alone"] < 1.01 * first  # whatever the depth
        assert grown["alone"] < grown["backprop"]
    assert values["networks"]["maps"]["3"]["groups"] == "1,2,3"
    assert cv2.imread(str(picture)) is not None


def test_a_look_is_compared_with_the_networks_alone_and_finds_what_is_there(tmp_path: Path) -> None:
    printed, values = told(tmp_path, "look.py", "--objects", 1, "--repeats", 1)
    assert max(map(len, printed.splitlines())) <= 80
    assert set(values["ms"]) == {"look", "network_alone", "nothing_found"}
    for key in ("first_ms", "median_ms", "least_ms"):
        times = [values["ms"][name][key] for name in ("look", "network_alone")]
        assert values["ratio"][key] == pytest.approx(times[0] / times[1])
    assert values["found"] > 0.5 > values["false_alarms"]


@pytest.fixture
def peer(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Gives a module of `benchmarks/peers` by its name."""
    monkeypatch.syspath_prepend(str(PEERS))

    def module(name: str) -> ModuleType:
        spec = importlib.util.spec_from_file_location(f"peers_{name}", PEERS / f"{name}.py")
        assert spec is not None
        assert spec.loader is not None
        made = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(made)
        return made

    return module


@pytest.fixture
def job(peer: Any, frames_folder: Path, bundle: Bundle) -> dict[str, Any]:
    frame = read_demonstration(frames_folder / "bar.png")
    made: dict[str, Any] = peer("step_data").step_data(frame, bundle, 3, 25)
    return made


def test_a_torch_step_does_what_a_backpropagation_step_here_does(
    peer: Any, job: dict[str, Any]
) -> None:
    plain = {**job, "momentum": np.float32(0)}
    for data, expected in ((job, "losses"), (plain, "plain_losses")):
        step = peer("torch_steps").eager_step(data, 1)
        arrays = (torch.from_numpy(data[name]) for name in ("features", "labels", "rows"))
        losses, times = peer("steps").timed_steps(step, *arrays, 1e9)
        assert len(times) == 25
        np.testing.assert_allclose(losses[:20], data[expected], rtol=1e-4)


@pytest.mark.parametrize("encoding", ["double", "paper"])
def test_every_form_of_the_loss_is_the_networks_own(
    peer: Any, job: dict[str, Any], encoding: str
) -> None:
    given = {**job, "encoding": np.array(encoding)}
    nets = [getattr(peer("torch_steps"), name)(given) for name in ("Net", "ExportedNet")]
    x, labels = (torch.from_numpy(job[name][job["rows"][0]]) for name in ("features", "labels"))
    raw = torch.randn(32, 3, generator=torch.Generator().manual_seed(0)) * 4
    heads = GraspTask(encoding, float(job["smoothing"])).heads  # type: ignore[arg-type]
    torch.testing.assert_close(nets[0].loss(raw, labels), mean_loss(heads, raw, labels))
    losses = [net(x, labels) for net in nets]
    torch.testing.assert_close(*losses)
    model = peer("ort_training_steps").loss_model(given)
    session = ort.InferenceSession(model.SerializeToString())
    (found,) = session.run(None, {"features": x.numpy(), "labels": labels.numpy()})
    assert found == pytest.approx(losses[0].item(), rel=1e-5)


def test_jobs_for_other_pythons_import_nothing_of_this_package() -> None:
    for script in ("steps.py", "torch_steps.py", "ort_training_steps.py"):
        for node in ast.walk(ast.parse((PEERS / script).read_text())):
            names = [one.name for one in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not [name for name in names if name.partition(".")[0] == "qsgm"]


PRINTED = """
path, threads, seconds = sys.argv[-3:]
print("something that a library says")
print(json.dumps({"version": "1", "imported_at": 0.0, "setup_seconds": 2.0, "steps": 3,
    "step_seconds": 0.001 * int(threads), "losses": (LOSSES).tolist()}))"""


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ('assert "PYTHONPATH" not in os.environ' + PRINTED.replace("LOSSES", "losses"), None),
        (PRINTED.replace("LOSSES", "losses * 1.1"), "its losses differ by 10 %"),
        (PRINTED.replace("LOSSES", "losses * np.nan"), "its losses differ by nan %"),
        ("import a_module_that_is_not_there", "No module named 'a_module_that_is_not_there'"),
        ("sys.exit(3)", "exit code 3"),
        ("sys.exit('a.b.SomeError: it broke\\n\\nTurn on some log')", "^a.b.SomeError: it broke$"),
        ("print('what a library says')", "printed no result"),
    ],
)
def test_a_peer_says_its_time_or_why_it_has_none(
    peer: Any,
    job: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    body: str,
    reason: str | None,
) -> None:
    monkeypatch.setenv("PYTHONPATH", "/somewhere")
    main, data, python = peer("__main__"), tmp_path / "job.npz", tmp_path / "python"
    np.savez(data, **job)
    load = 'losses = np.load(sys.argv[-3])["losses"]'
    imports = "import json, os, sys\nimport numpy as np"
    python.write_text(f"#!{sys.executable}\n{imports}\n{load}\n{body}\n")
    python.chmod(0o755)
    if reason is None:
        assert main.run_peer("executorch", python, data, 2)["step_seconds"] == 0.002
        return
    with pytest.raises(main.PeerError, match=reason):
        main.run_peer("executorch", python, data, 1)
