"""deploy/ros2 without ROS: messages are stubs that have the fields of the real ones, no others."""

import ast
import runpy
import sys
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from qsgm_ros.finder import Finder, Messages, Options
from qsgm_ros.images import ENCODINGS, frame_of

from qsgm import QsgmError, load_object, paths, read_frame

PACKAGE = Path(__file__).parents[2] / "deploy" / "ros2"
CALIB = Path(__file__).parents[2] / "calib"


@dataclass(slots=True)
class Header:
    stamp: tuple[int, int] = (0, 0)
    frame_id: str = ""


@dataclass(slots=True)
class Image:
    header: Header = field(default_factory=Header)
    height: int = 0
    width: int = 0
    encoding: str = ""
    is_bigendian: int = 0
    step: int = 0
    data: bytes = b""


@dataclass(slots=True)
class Point2D:
    x: float = 0.0
    y: float = 0.0


@dataclass(slots=True)
class Pose2D:
    position: Point2D = field(default_factory=Point2D)
    theta: float = 0.0


@dataclass(slots=True)
class BoundingBox2D:
    center: Pose2D = field(default_factory=Pose2D)
    size_x: float = 0.0
    size_y: float = 0.0


@dataclass(slots=True)
class Hypothesis:
    class_id: str = ""
    score: float = 0.0


@dataclass(slots=True)
class HypothesisWithPose:
    hypothesis: Hypothesis = field(default_factory=Hypothesis)
    pose: object = None


@dataclass(slots=True)
class Detection2D:
    header: Header = field(default_factory=Header)
    results: list[HypothesisWithPose] = field(default_factory=list)
    bbox: BoundingBox2D = field(default_factory=BoundingBox2D)
    id: str = ""


@dataclass(slots=True)
class Detection2DArray:
    header: Header = field(default_factory=Header)
    detections: list[Detection2D] = field(default_factory=list)


STUBS = Messages(Image, Detection2DArray, Detection2D, HypothesisWithPose)
HEADER = Header((12, 345), "camera_optical_frame")


def image_of(frame: NDArray[np.uint8], encoding: str = "bgr8", padding: int = 0) -> Image:
    """A frame as a camera's driver sends it, rows longer by so many bytes of rubbish."""
    blue, green, red = np.moveaxis(frame, 2, 0)
    opacity = np.full_like(blue, 7)
    channels = {
        "bgr8": [blue, green, red],
        "rgb8": [red, green, blue],
        "bgra8": [blue, green, red, opacity],
        "rgba8": [red, green, blue, opacity],
        "mono8": [green],
    }[encoding]
    rows = np.stack(channels, axis=2).reshape(len(frame), -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=99)
    height, width = frame.shape[:2]
    return Image(HEADER, height, width, encoding, 0, rows.shape[1], rows.tobytes())


@pytest.fixture
def pixels() -> NDArray[np.uint8]:
    return np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("home")


@pytest.fixture(scope="module")
def taught(home: Path) -> Finder:
    """A finder that was shown the demo's object."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_DATA_HOME", str(home))
        finder = Finder(Options(epochs=2), STUBS)
        finder.see(image_of(read_frame(CALIB / "demo_object.png")))
        success, message = finder.teach("mug")
    assert success
    assert message.startswith(("mug will be found", "mug may be missed"))
    return finder


@pytest.mark.parametrize("padding", [0, 1, 13])
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_images_of_every_encoding_become_bgr_however_long_their_rows_are(
    pixels: NDArray[np.uint8], encoding: str, padding: int
) -> None:
    expected = pixels[:, :, [1, 1, 1]] if encoding == "mono8" else pixels
    np.testing.assert_array_equal(frame_of(image_of(pixels, encoding, padding)), expected)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"encoding": "bayer_rggb8"}, "encoding is 'bayer_rggb8': expected one of bgr8, rgb8"),
        ({"encoding": "evil\nline"}, "expected one of bgr8"),
        ({"height": 0}, "105 bytes, 0 rows of 21 for 7 pixels of 3"),
        ({"width": 0}, "for 0 pixels"),
        ({"width": 8}, "for 8 pixels"),
        ({"height": 6}, "6 rows of 21"),
        ({"step": 20}, "rows of 20"),
        ({"step": 2**32 - 1}, "rows of 4294967295"),
        ({"data": b""}, "0 bytes"),
        ({"data": b"x" * 106}, "106 bytes"),
    ],
)
def test_images_that_contradict_themselves_are_refused_in_one_line(
    pixels: NDArray[np.uint8], changes: dict[str, Any], said: str
) -> None:
    image = image_of(pixels)
    for name, value in changes.items():
        setattr(image, name, value)
    with pytest.raises(QsgmError) as refused:
        frame_of(image)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_images_larger_than_any_frame_are_refused() -> None:
    wide = Image(HEADER, 1, 5000, "mono8", 0, 5000, bytes(5000))
    with pytest.raises(QsgmError, match="4096"):
        frame_of(wide)


def test_the_object_that_was_taught_is_found_again(taught: Finder) -> None:
    scene = read_frame(CALIB / "demo_scene.png")
    found, picture = taught.see(image_of(scene, padding=5))
    (one,) = found.detections
    assert (found.header, one.header, picture.header) == (HEADER, HEADER, HEADER)
    assert (one.id, one.results[0].hypothesis.class_id) == ("mug", "mug")
    assert one.results[0].hypothesis.score > 0.5
    # As README has it of the same two pictures: -60.2 degrees counter-clockwise.
    center = one.bbox.center
    assert np.hypot(center.position.x - 207.7, center.position.y - 300.7) < 3
    assert abs(np.degrees(center.theta) - 60.2) < 3
    np.testing.assert_allclose(one.bbox.size_x, 128, atol=40)
    drawn = frame_of(picture)
    assert drawn.shape == scene.shape
    assert (drawn != scene).any()


def test_nothing_is_found_where_the_object_is_not(taught: Finder) -> None:
    empty = np.random.default_rng(0).integers(90, 110, (480, 640, 3), np.uint8)
    found, picture = taught.see(image_of(empty, "rgb8"))
    assert found.detections == []
    assert (found.header, picture.header) == (HEADER, HEADER)
    assert picture.encoding == "bgr8"


def test_what_was_taught_is_there_after_a_restart_and_in_qsgm(
    taught: Finder, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(home))
    again = Finder(Options(objects=["", "mug"]), STUBS)
    assert again.names == taught.names == ["mug"]
    assert load_object(paths.folder_named("mug")).description.name == "mug"


def test_unknown_objects_and_bundles_are_refused_at_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    with pytest.raises(QsgmError, match="there is no object cup"):
        Finder(Options(objects=["cup"]), STUBS)
    with pytest.raises(QsgmError, match="nowhere"):
        Finder(Options(bundle=str(tmp_path / "nowhere")), STUBS)


def test_teaching_says_what_is_wrong_and_forgets_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    finder = Finder(Options(epochs=1), STUBS)
    assert finder.teach("mug") == (
        False,
        "no image has come yet: expected one; check the camera's topic",
    )
    finder.see(image_of(np.zeros((100, 120, 3), np.uint8)))
    success, message = finder.teach("mug")
    assert not success
    assert message.startswith("the last image is 120x100 px, too small")
    finder.see(image_of(read_frame(CALIB / "demo_object.png")))
    assert finder.teach(" ") == (False, "the object has no name: expected one; set `teach_as`")
    assert finder.names == []
    assert not list(tmp_path.rglob("*.onnx"))


class FakeNode:
    """What the node asks of rclpy's."""

    parameters: dict[str, Any] = {}  # noqa: RUF012

    def __init__(self, name: str) -> None:
        self.name, self.declared, self.published = name, dict[str, Any](), dict[str, list[Any]]()
        self.heard: dict[str, Any] = {}
        self.errors: list[str] = []

    def declare_parameter(self, name: str, value: Any) -> None:
        self.declared[name] = self.parameters.get(name, value)

    def get_parameter(self, name: str) -> Any:
        return SimpleNamespace(value=self.declared[name])

    def create_publisher(self, _kind: type, topic: str, _qos: Any) -> Any:
        return SimpleNamespace(publish=self.published.setdefault(topic, []).append)

    def create_subscription(self, _kind: type, topic: str, callback: Any, _qos: Any) -> None:
        self.heard[topic] = callback

    def create_service(self, _kind: type, name: str, callback: Any) -> None:
        self.heard[name] = callback

    def get_logger(self) -> Any:
        def error(text: str, throttle_duration_sec: float) -> None:
            assert throttle_duration_sec > 0
            self.errors.append(text)

        return SimpleNamespace(info=lambda _text: None, error=error)


@pytest.fixture
def node_module(monkeypatch: pytest.MonkeyPatch) -> Any:
    """`qsgm_ros.node` on stubs in the place of ROS."""
    anything = SimpleNamespace(KEEP_LAST=1, BEST_EFFORT=1)
    contents = {
        "rclpy": {},
        "rclpy.executors": {"ExternalShutdownException": KeyboardInterrupt},
        "rclpy.node": {"Node": FakeNode},
        "rclpy.qos": {
            "HistoryPolicy": anything,
            "ReliabilityPolicy": anything,
            "QoSProfile": SimpleNamespace,
        },
        "sensor_msgs.msg": {"Image": Image},
        "std_srvs.srv": {"Trigger": SimpleNamespace(Request=object, Response=SimpleNamespace)},
        "vision_msgs.msg": {
            "Detection2D": Detection2D,
            "Detection2DArray": Detection2DArray,
            "ObjectHypothesisWithPose": HypothesisWithPose,
        },
    }
    for name, values in contents.items():
        for part in (name.partition(".")[0], name):
            if part not in sys.modules:
                monkeypatch.setitem(sys.modules, part, ModuleType(part))
        vars(sys.modules[name]).update(values)
    monkeypatch.delitem(sys.modules, "qsgm_ros.node", raising=False)
    import qsgm_ros.node

    yield qsgm_ros.node
    del sys.modules["qsgm_ros.node"]


def test_the_node_hands_on_what_comes(
    node_module: Any, taught: Finder, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert taught.names == ["mug"]
    monkeypatch.setenv("XDG_DATA_HOME", str(home))
    monkeypatch.setattr(FakeNode, "parameters", {"objects": ["mug"], "epochs": 1, "teach_as": "2"})
    node = node_module.FinderNode()
    assert node.heard.keys() == {"image", "teach"}
    node.heard["image"](image_of(read_frame(CALIB / "demo_scene.png")))
    assert [one.id for one in node.published["detections"][0].detections] == ["mug"]
    assert node.published["debug_image"][0].header == HEADER
    node.heard["image"](Image(HEADER))
    assert len(node.published["detections"]) == 1
    assert node.errors[0].startswith("the image's encoding is ''")
    node.heard["image"](image_of(read_frame(CALIB / "demo_object.png")))
    response = node.heard["teach"](None, SimpleNamespace())
    assert response.success
    assert node.finder.names == ["mug", "2"]


def test_the_package_is_what_its_files_say(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("setuptools")  # not in environments of Python 3.12
    about = ET.parse(PACKAGE / "package.xml").getroot()
    built: dict[str, Any] = {}
    monkeypatch.chdir(PACKAGE)
    monkeypatch.setattr("setuptools.setup", built.update)
    runpy.run_path("setup.py")
    assert built["name"] == about.findtext("name")
    assert built["version"] == about.findtext("version")
    assert about.findtext("export/build_type") == "ament_python"
    files = [Path(name) for _, names in built["data_files"] for name in names]
    assert len(files) == 4
    assert all(name.is_file() for name in files)
    (script,) = built["entry_points"]["console_scripts"]
    module, function = script.partition("= ")[2].split(":")
    tree = ast.parse(Path(*module.split(".")).with_suffix(".py").read_text())
    assert function in {one.name for one in tree.body if isinstance(one, ast.FunctionDef)}


def test_the_file_of_parameters_has_every_one_at_its_default() -> None:
    lines = (PACKAGE / "config" / "finder.yaml").read_text().splitlines()
    written = dict(line.strip().split(": ") for line in lines if line.startswith("    "))
    defaults = {**vars(Options()), "objects": [""]}
    python = {"true": "True", "false": "False"}
    assert {
        name: ast.literal_eval(python.get(value, value)) for name, value in written.items()
    } == defaults
