"""Look-up: the flag first, then the installed copy, then the checkout."""

from pathlib import Path

import pytest

from qsgm import paths
from qsgm.errors import QsgmError


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A made-up installation: `installed/` and `checkout/` below a temporary folder."""
    package = tmp_path / "checkout" / "qsgm"
    package.mkdir(parents=True)
    monkeypatch.setattr(paths, "files", lambda _: tmp_path / "installed")
    monkeypatch.setattr(paths, "__file__", str(package / "paths.py"))
    return tmp_path


@pytest.fixture(autouse=True)
def data_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    return tmp_path / "data"


def make(folder: Path) -> Path:
    folder.mkdir(parents=True)
    return folder


def test_the_installed_copy_comes_before_the_checkout(places: Path) -> None:
    (places / "checkout" / "pyproject.toml").touch()
    in_checkout = make(places / "checkout" / "export")
    assert paths.bundle_folder() == in_checkout
    installed = make(places / "installed" / "artifacts" / "export")
    assert paths.bundle_folder() == installed


def test_the_flag_comes_first(places: Path) -> None:
    make(places / "installed" / "artifacts" / "calib")
    mine = make(places / "mine")
    assert paths.calibration_folder(mine) == mine


def test_a_folder_beside_the_package_counts_only_in_a_checkout(places: Path) -> None:
    make(places / "checkout" / "export")
    with pytest.raises(QsgmError, match=r"without export/ .*; pass --bundle DIR"):
        paths.bundle_folder()


@pytest.mark.usefixtures("places")
def test_without_a_copy_the_message_names_the_option() -> None:
    with pytest.raises(QsgmError, match=r"without calib/ .*; pass --calib DIR"):
        paths.calibration_folder()


@pytest.mark.parametrize("name", ["missing", "file", "n" * 300])
def test_a_flag_that_names_no_folder_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(QsgmError, match=r"--bundle .*: there is no such folder"):
        paths.bundle_folder(tmp_path / name)


@pytest.mark.parametrize(
    ("frame", "name"),
    [
        ("photos/mug.png", "mug"),
        ("my mug (2).jpg", "my_mug_2"),
        ("..png", "object"),
        ("???", "object"),
    ],
)
def test_an_object_is_named_after_its_frame(data_home: Path, frame: str, name: str) -> None:
    assert paths.object_folder(Path(frame)) == data_home / "qsgm" / "objects" / name


def test_the_last_object_is_remembered_wherever_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = make(tmp_path / "first"), make(tmp_path / "second")
    monkeypatch.chdir(tmp_path)
    paths.remember_object(first)
    paths.remember_object(Path("second"))
    monkeypatch.chdir("/")
    assert paths.last_object_folder() == second


def test_without_a_tuned_object_the_message_says_how_to_get_one() -> None:
    with pytest.raises(QsgmError, match=r"no object was tuned here yet: run .* or pass --object"):
        paths.last_object_folder()


def test_an_object_that_was_deleted_is_named(tmp_path: Path) -> None:
    gone = make(tmp_path / "gone")
    paths.remember_object(gone)
    gone.rmdir()
    with pytest.raises(QsgmError, match=r"tuned last, .*gone, is gone"):
        paths.last_object_folder()


def test_a_relative_data_home_is_ignored(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", "relative")
    monkeypatch.setenv("HOME", str(tmp_path))
    expected = tmp_path / ".local" / "share" / "qsgm" / "objects" / "mug"
    assert paths.object_folder(Path("mug.png")) == expected
