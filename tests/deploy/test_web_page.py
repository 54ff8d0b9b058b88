"""The page of deploy/web in a real browser: it teaches, finds, saves, opens and asks for nothing.

Skipped, saying so, without Chromium, node or onnxruntime-web.
"""

import functools
import http.server
import json
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from chromium import Page, chromium_path
from web import CALIB, EXPORT, alone, built, needs_ort

from qsgm import Settings, finetune, load_bundle, load_object, read_frame
from qsgm.grasp.tuned import TunedObject, read_object

pytestmark = [
    needs_ort,
    pytest.mark.skipif(chromium_path() is None, reason="Chromium is not installed"),
]


READY = "document.body?.dataset.ready !== undefined"


class Server:
    """A folder served to this machine."""

    def __init__(self, folder: Path) -> None:
        self.asked: list[str] = []
        asked = self.asked

        class Handler(http.server.SimpleHTTPRequestHandler):
            def log_message(self, *_: object) -> None:
                asked.append(self.path)

        handler = functools.partial(Handler, directory=str(folder))
        self._server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
        self._thread = threading.Thread(target=self._server.serve_forever)
        self._thread.start()
        self.url = f"http://127.0.0.1:{self._server.server_port}/"

    def stop(self) -> None:
        """End it, if that has not been done."""
        if self._thread.is_alive():
            self._server.shutdown()
            self._thread.join()
            self._server.server_close()


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    server = Server(built(tmp_path_factory.mktemp("web")))
    yield server
    server.stop()


@pytest.fixture(scope="module")
def loaded(server: Server, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """The page, loaded for the first time."""
    with Page(tmp_path_factory.mktemp("browser")) as page:
        page.open(server.url)
        page.until(READY)
        yield page


@pytest.fixture
def page(loaded: Page) -> Iterator[Page]:
    """The page, of which nothing was asked yet; nothing may go wrong in it."""
    loaded.requests.clear()
    yield loaded
    assert loaded.problems == []


def text(page: Page, name: str) -> str:
    return str(page.run(f"document.getElementById({name!r}).textContent"))


def click(page: Page, name: str) -> None:
    page.until(f"!document.getElementById({name!r}).disabled")
    page.run(f"document.getElementById({name!r}).click()")


def find(page: Page, scene: Path) -> None:
    page.until("!document.getElementById('look').disabled")
    page.run("document.getElementById('found').textContent = ''")
    page.choose("#look", scene)
    page.until("document.getElementById('found').textContent !== ''")


def assert_says(page: Page, tuned: TunedObject, scene: Path) -> None:
    """What is on the page is what Python says of the scene."""
    expected, _ = tuned.locate(read_frame(scene))
    assert text(page, "found") == f"found\nquality {expected.quality:.2f}"
    right, down = (round(value) for value in expected.displacement_px)
    ways = "left" if right < 0 else "right", "up" if down < 0 else "down"
    assert text(page, "move") == f"{abs(right)} px {ways[0]}\n{abs(down)} px {ways[1]}"
    way = "clockwise" if expected.angle_deg < 0 else "counter-clockwise"
    turn, said = text(page, "turn").split("\n")
    assert said == way
    np.testing.assert_allclose(float(turn.rstrip("°")), abs(expected.angle_deg), atol=0.06)


@pytest.mark.usefixtures("page")
def test_what_is_large_is_fetched_once(server: Server) -> None:
    large = [path for path in server.asked if path.startswith(("/ort/", "/bundle/", "/example/"))]
    assert len(large) > 10
    assert len(large) == len(set(large))


def test_an_object_is_taught_found_and_saved_without_a_request(page: Page, tmp_path: Path) -> None:
    scene = CALIB / "demo_scene.png"
    page.choose("#choose", CALIB / "demo_object.png")
    page.until("!document.getElementById('teach').disabled")
    page.run("document.getElementById('name').value = 'hammer'")
    click(page, "teach")
    page.until("document.getElementById('verdict').textContent !== ''")
    assert text(page, "verdict").startswith("It will be found")
    assert page.run("document.querySelectorAll('#crops canvas').length") == 24
    rows = page.run("[...document.querySelectorAll('#cosines tr')].map((row) => row.innerText)")
    assert [row.split()[:2] for row in rows] == [["Layer", "4"], ["Layer", "5"]]
    assert all(float(row.split()[2]) > 0.99 for row in rows)
    find(page, scene)
    page("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    click(page, "save")
    page.until("document.getElementById('status').textContent.startsWith('Saved')")
    page.until_true((tmp_path / "object.zip").exists)
    with zipfile.ZipFile(tmp_path / "object.zip") as file:
        file.extractall(tmp_path)
    tuned = load_object(tmp_path / "hammer")
    assert json.loads((tmp_path / "hammer/object.json").read_text())["made"]["by"] == "browser"
    assert_says(page, tuned, scene)
    assert [url for url in page.requests if not url.startswith(("blob:", "data:"))] == []


def test_an_object_of_python_opens_in_the_page(page: Page, tmp_path: Path) -> None:
    scene = CALIB / "demo_scene.png"
    frame, bundle = read_frame(CALIB / "demo_object.png"), load_bundle(EXPORT)
    finetune(frame, bundle, Settings(epochs=1), span_px=90.0).save(tmp_path / "mug", "mug")
    page.choose("#open", tmp_path / "mug/object.json", tmp_path / "mug/network.onnx")
    page.until("document.getElementById('status').textContent.includes('is open')")
    assert "patch is left aside" in text(page, "status")
    find(page, scene)
    assert_says(page, alone(*read_object(tmp_path / "mug")), scene)
    page.choose("#open", scene)
    page.until("document.getElementById('status').className === 'bad'")
    assert "This is no object" in text(page, "status")


def test_its_policy_keeps_page_and_worker_from_other_hosts(page: Page) -> None:
    asked = """fetch('http://127.0.0.2:9/').then(() => 'asked', (error) => error.name)"""
    worker = f"""new Promise((done) => {{
        const source = `{asked}.then((said) => postMessage(said))`;
        const worker = new Worker(URL.createObjectURL(new Blob([source])));
        worker.onmessage = ({{ data }}) => done(data);
    }})"""
    assert page.run(asked) == "TypeError"
    assert page.run(worker) == "TypeError"
    assert not [url for url in page.requests if "127.0.0.2" in url]
    refused = [one for one in page.problems if "Content Security Policy" in one]
    assert refused
    page.problems.clear()


@pytest.mark.parametrize("width", [390, 1280])
def test_nothing_is_wider_than_its_screen_and_everything_has_a_name(page: Page, width: int) -> None:
    page.resize(width, 844)
    page.run("document.getElementById('example').click()")
    page.until("document.getElementById('taught').classList.contains('full')")
    assert page.run("document.documentElement.scrollWidth") <= width
    nodes = page("Accessibility.getFullAXTree")["nodes"]
    roles = {"button", "slider", "textbox", "application", "progressbar"}
    named = [one for one in nodes if one.get("role", {}).get("value") in roles]
    assert len(named) > 10
    assert [one for one in named if not one["ignored"] and not one["name"]["value"]] == []


def test_the_page_needs_no_server_after_its_first_visit(page: Page, server: Server) -> None:
    server.stop()
    page.run("document.body.dataset.old = ''")
    page("Page.reload")
    page.until(f"document.body?.dataset.old === undefined && {READY}")
    click(page, "camera")
    page.until("document.getElementById('taught').classList.contains('full')")
    assert text(page, "camera") == "Stop the camera"
    click(page, "camera")
    page.until("document.getElementById('camera').textContent === 'Camera'")
