"""deploy/web, run by node: its numbers are Python's, and objects go both ways.

What needs node or onnxruntime-web (`npm install` in deploy/web, or ONNXRUNTIME_WEB) is skipped
where they are not, and says so.
"""

import json
import re
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from web import CALIB, EXPORT, WEB, Frame, alone, built, needs_node, needs_ort, run_job

from qsgm import Bundle, Settings, load_bundle, load_object, read_frame, resolve
from qsgm.grasp.measuring import scaled_frame
from qsgm.grasp.source import Demonstration, crop_source
from qsgm.grasp.task import distractors_of
from qsgm.grasp.teach import finetune, prepare_object, train_object
from qsgm.grasp.tuned import ObjectDescription, TunedObject, read_object
from qsgm.tune.prepare import in_step_layout

MOST_OWN_BYTES = 90_000


@pytest.fixture(scope="module")
def shipped() -> Bundle:
    return load_bundle(EXPORT)


@pytest.fixture(scope="module")
def shown() -> Frame:
    return read_frame(CALIB / "demo_object.png")


@pytest.fixture(scope="module")
def scene() -> Frame:
    return read_frame(CALIB / "demo_scene.png")


def assert_same_place(found: dict[str, Any], tuned: TunedObject, frame: Frame) -> None:
    expected, _ = tuned.locate(frame)
    assert found["found"] == expected.found
    np.testing.assert_allclose(found["quality"], expected.quality, atol=1e-4)
    np.testing.assert_allclose(found["center"], expected.center_px, atol=0.1)
    np.testing.assert_allclose(found["move"], expected.displacement_px, atol=0.1)
    assert abs((found["turnDeg"] - expected.angle_deg + 90) % 180 - 90) < 0.01


@needs_node
def test_draws_are_numpys(tmp_path: Path) -> None:
    for seed in ([7], [0, 1], [7, 1, 9, 4, 5, 6]):
        job = {"seed": seed, "count": 20_000}
        got = run_job(tmp_path, runtime=False, draws=job)["draws"]
        rng = np.random.default_rng(seed)
        exact = {
            "random": rng.random(9),
            "integers": rng.integers(0, 65, 101),
            "permutation": rng.permutation(1000),
            "choice": rng.choice(800, 32, replace=False),
            "uniform": rng.uniform(-3, 5, 7),
        }
        for name, expected in exact.items():
            np.testing.assert_array_equal(got[name], expected, name)
        # Their tables are computed, not copied: the last digits differ.
        np.testing.assert_allclose(got["normal"], rng.normal(size=20_000), rtol=1e-12)
        np.testing.assert_allclose(got["exponential"], rng.exponential(size=20_000), rtol=1e-12)


@needs_node
@pytest.mark.parametrize(("seed", "center"), [(5, (150.0, 200.5))])
def test_plan_and_crops_are_the_same_bytes(
    seed: int, center: tuple[float, float], shown: Frame, shipped: Bundle, tmp_path: Path
) -> None:
    job = {"frame": shown, "center": center, "plan": {"seed": seed}, "bundle": EXPORT, "layers": 3}
    plan = run_job(tmp_path, runtime=False, **job)["plan"]
    things = distractors_of(shipped)
    source = crop_source([Demonstration(shown, center)], things, np.random.default_rng(seed))
    assert source.clutter is not None
    theirs = {
        "quality": source.plan.quality,
        "center": source.plan.center_px,
        "turn": source.plan.turn_rad,
        "color": source.plan.color,
    }
    for name, value in theirs.items():
        np.testing.assert_array_equal(np.array(plan[name], np.float32), value.ravel(), name)
    clutter, expected = plan["clutter"], source.clutter
    np.testing.assert_array_equal(clutter["addition"], expected.addition)
    pairs = {"center": "center_px", "turn": "turn_rad"}
    for name, value in clutter["things"].items():
        other = getattr(expected.things, pairs.get(name, name))
        np.testing.assert_array_equal(np.array(value, other.dtype), other.ravel(), name)
    for name, value in clutter["edges"].items():
        other = getattr(expected.edges, {"colour": "color"}.get(name, name))
        np.testing.assert_array_equal(value, other.ravel(), name)
    crops = np.fromfile(tmp_path / "crops.bin", np.uint8).reshape(-1, 128, 128, 3)
    np.testing.assert_array_equal(crops, source.cut(np.arange(len(source))))


@needs_node
@pytest.mark.parametrize("scale", [0.5, 0.31, 0.73, 1.5])
def test_frames_are_scaled_as_opencv_scales_them(
    scale: float, shown: Frame, tmp_path: Path
) -> None:
    run_job(tmp_path, runtime=False, frame=shown, scale=scale)
    expected = scaled_frame(shown, scale)
    got = np.fromfile(tmp_path / "scaled.bin", np.uint8).reshape(*expected.shape[:2], 4)[..., :3]
    # OpenCV 5 gives the same bytes here; which ones is its own affair on other machines.
    assert np.abs(got.astype(int) - expected).max() <= 1
    assert (got != expected).mean() < 0.01


# Where int8 rounds, a last bit of float becomes a step: runs part sooner. Three layers and four:
# the fourth goes crop by crop (Scan).
@needs_ort
@pytest.mark.parametrize(
    ("layers", "precision", "epochs", "loss", "weight"),
    [(3, "float", 3, 5e-6, 1e-3), (3, "int8", 1, 1e-4, 5e-3), (4, "float", 1, 5e-6, 1e-3)],
)
def test_steps_on_the_same_features_are_the_same(
    layers: int,
    precision: Any,
    epochs: int,
    loss: float,
    weight: float,
    shown: Frame,
    shipped: Bundle,
    tmp_path: Path,
) -> None:
    plan = resolve(Settings(precision=precision, epochs=epochs, layers=layers), shipped)
    prepared = prepare_object(shown, shipped, plan, span_px=90.0)
    prepared.features.tofile(tmp_path / "given.bin")
    given = {"file": tmp_path / "given.bin", "dims": prepared.features.shape[1:]}
    settings = {"seed": 0, "precision": precision, "epochs": epochs, "features": given}
    got = run_job(
        tmp_path,
        bundle=EXPORT,
        layers=layers,
        frame=shown,
        center=(320, 240),
        tune=settings,
    )["tuned"]
    expected = train_object(prepared, plan)
    np.testing.assert_allclose(np.reshape(got["labels"], (-1, 3)), prepared.labels, atol=1e-5)
    np.testing.assert_allclose(got["losses"], expected.losses, atol=loss)
    for name, value in in_step_layout(expected.weights).items():
        np.testing.assert_allclose(got["weights"][name], value.ravel(), atol=weight)
    assert abs(got["scores"]["detection"] - expected.scores["detection_accuracy"]) <= 0.015
    np.testing.assert_allclose(
        got["scores"]["angleDeg"], expected.scores["angle_mae_deg"], atol=0.1
    )
    # One look before each epoch and one at the end.
    probes = [event for event in got["told"] if event["kind"] == "probe"]
    assert [probe["step"] for probe in probes] == list(range(0, 25 * epochs + 1, 25))
    for values in got["fidelity"].values():
        assert values["int8Float"] > 0.99


@needs_ort
def test_an_object_taught_by_node_is_found_by_python(
    shown: Frame, scene: Frame, shipped: Bundle, tmp_path: Path
) -> None:
    answers = run_job(
        tmp_path,
        bundle=EXPORT,
        layers=3,
        frame=shown,
        center=(320, 240),
        tune={"seed": 0, "precision": "int8", "epochs": 3},
        name="hammer",
        save=True,
        scenes=[scene, scene[60:400, 100:612]],
    )
    with zipfile.ZipFile(tmp_path / "object.zip") as file:
        assert file.testzip() is None
        file.extractall(tmp_path / "unpacked")
    tuned = load_object(tmp_path / "unpacked" / "hammer")
    assert tuned.description.name == "hammer"
    assert tuned.description.views == ()
    for found, frame in zip(answers["found"], (scene, scene[60:400, 100:612]), strict=True):
        assert found["found"]
        assert_same_place(found, tuned, np.ascontiguousarray(frame))
    # The whole job by Python: the frozen layers round a few codes otherwise, no more.
    plan = resolve(Settings(precision="int8", epochs=3), shipped)
    prepared = prepare_object(shown, shipped, plan, span_px=90.0)
    features = np.fromfile(tmp_path / "features.bin", np.uint8).astype(int)
    off = np.abs(features - prepared.features.ravel())
    assert off.max() <= 1
    assert off.mean() < 1e-4
    result = train_object(prepared, plan)
    theirs, _ = alone(result.tuned_object().description, result.network()).locate(scene)
    np.testing.assert_allclose(answers["found"][0]["center"], theirs.center_px, atol=1)
    assert abs(answers["found"][0]["turnDeg"] - theirs.angle_deg) < 1


@needs_ort
def test_an_object_taught_by_python_is_found_by_node(
    shown: Frame, scene: Frame, shipped: Bundle, tmp_path: Path
) -> None:
    large = cv2.resize(shown, None, fx=1.6, fy=1.6, interpolation=cv2.INTER_CUBIC)
    result = finetune(large.astype(np.uint8), shipped, Settings(epochs=1), span_px=150.0)
    result.save(tmp_path / "hammer", "hammer")
    scenes = [cv2.resize(scene, None, fx=1.6, fy=1.6, interpolation=cv2.INTER_CUBIC)]
    files = [tmp_path / "hammer" / name for name in ("object.json", "network.onnx")]
    answers = run_job(tmp_path, open=files, scenes=scenes)
    assert answers["opened"]["about"]["name"] == "hammer"
    assert answers["opened"]["views"] == 1
    assert result.prepared.shown.scale == pytest.approx(0.6)
    assert_same_place(answers["found"][0], alone(*read_object(tmp_path / "hammer")), scenes[0])
    with zipfile.ZipFile(tmp_path / "h.zip", "w", zipfile.ZIP_DEFLATED) as zipped:
        for file in files:
            zipped.write(file, f"hammer/{file.name}")
    again = run_job(tmp_path, open=[tmp_path / "h.zip"], scenes=scenes)
    assert again["found"] == answers["found"]


@needs_node
@pytest.mark.parametrize("what", ["network", "json", "task", "scale", "zip"])
def test_what_is_no_object_is_refused(what: str, shipped: Bundle, tmp_path: Path) -> None:
    network = shipped.network_with({})
    about = ObjectDescription("mug", "double", 0.0)
    values = {"name": about.name, "encoding": about.encoding, "offset_rad": 0.0, "scale": 1.0}
    values |= {"format": "qsgm-object", "version": 2, "views": [], "made": {}, "sha256": "0" * 64}
    values |= {"task": {"task": "arrays"}, "scale": {"scale": 1e9}}.get(what, {})
    description, graph = tmp_path / "object.json", tmp_path / "network.onnx"
    description.write_text("{" if what == "json" else json.dumps(values))
    graph.write_bytes(network)
    files = [description, graph]
    if what == "zip":
        files = [tmp_path / "object.zip"]
        files[0].write_bytes(b"no zip file at all, whatever it is called")
    refused = run_job(tmp_path, runtime=False, open=files)["refused"]
    assert "\n" not in refused
    expected = {"network": "network.onnx is not", "json": "damaged", "zip": "no zip"}
    assert expected.get(what, "describes no object") in refused


@needs_node
@pytest.mark.parametrize("said", [10, 80 * 2**20])
def test_a_zip_that_holds_more_than_it_says_or_may_is_refused(said: int, tmp_path: Path) -> None:
    path = tmp_path / "object.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as zipped:
        zipped.writestr("object.json", bytes(1000))
    size, data = (1000).to_bytes(4, "little"), path.read_bytes()
    assert data.count(size) == 2  # in the file's own head and in the list of all
    path.write_bytes(data.replace(size, said.to_bytes(4, "little")))
    assert run_job(tmp_path, runtime=False, open=[path])["refused"].startswith("The zip file holds")


@needs_ort
def test_what_is_built_is_all_that_the_page_names(tmp_path: Path) -> None:
    dist = built(tmp_path)
    modules = {path.name for path in WEB.glob("*.js")} - {"build.js"}
    assert modules == {path.name for path in dist.glob("*.js")}
    for path in dist.glob("*.js"):
        for name in re.findall(r'from "\./([^"]+)"', path.read_text()):
            assert (dist / name).exists(), (path.name, name)
    own = [path for path in dist.iterdir() if path.is_file()]
    assert sum(path.stat().st_size for path in own) < MOST_OWN_BYTES
    page = (dist / "index.html").read_text()
    for policy in ("default-src 'none'", "connect-src 'self'", "form-action 'none'"):
        assert policy in page
    for path in own:  # nothing is asked of others
        assert not re.findall(r"https?://(?!www\.w3\.org)", path.read_text()), path.name
    kept = json.loads(re.findall(r"const FILES = (\[.*\]);", (dist / "sw.js").read_text())[0])
    there = {str(path.relative_to(dist)) for path in dist.rglob("*") if path.is_file()}
    assert set(kept) == there - {"index.html", "sw.js"} | {"./"}
