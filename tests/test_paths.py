"""Look-up: the flag first, then the installed copy, then the checkout."""

import os
from pathlib import Path

import pytest

from qsgm import files, paths
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
        ("日本語.png", "日本語"),
        ("Tasse_ä-1.png", "Tasse_ä-1"),
        ("my mug (2).jpg", "my_mug_2-3448c49d"),
        ("???", "object-a03b221c"),
    ],
)
def test_an_object_is_named_after_its_frame(data_home: Path, frame: str, name: str) -> None:
    assert paths.object_folder(Path(frame)) == data_home / "qsgm" / "objects" / name


def test_different_names_never_come_to_the_same_folder() -> None:
    names = [
        "茶碗",
        "日本語",
        "a b",
        "a_b",
        "a  b",
        "a(b",
        "!",
        "?",
        ".a",
        "a.",
        "-",
        "\udcff",
        "\udcfe",
    ]
    names += ["x" * 60, "x" * 61, "x" * 62, "क", "का", "कि"]
    folders = {paths.object_folder(Path(f"{name}.png")) for name in names}
    assert len(folders) == len(names)
    assert all(len(os.fsencode(folder.name)) <= 255 for folder in folders)


def test_a_name_that_is_not_utf_8_or_ends_in_a_blank_is_remembered(tmp_path: Path) -> None:
    for name in ("mug \n", "mug\udcff", " mug "):
        folder = make(tmp_path / name)
        paths.remember_object(folder)
        assert paths.last_object_folder() == folder


@pytest.mark.parametrize("home", ["", "relative"])
def test_an_empty_home_is_none(monkeypatch: pytest.MonkeyPatch, home: str) -> None:
    monkeypatch.delenv("XDG_DATA_HOME")
    monkeypatch.setenv("HOME", home)
    with pytest.raises(QsgmError, match="no home folder"):
        paths.object_folder(Path("mug.png"))


@pytest.mark.parametrize("error", [PermissionError(13, "Permission denied"), OSError(5, "I/O")])
def test_a_data_folder_that_cannot_be_read_is_not_called_empty(
    monkeypatch: pytest.MonkeyPatch, error: OSError
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    paths.remember_object(Path())
    monkeypatch.setattr(files.os, "open", fail)
    with pytest.raises(QsgmError, match=r"cannot read .*last: "):
        paths.last_object_folder()


def test_a_folder_that_nobody_may_look_into_is_not_called_absent(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def fail(_: Path) -> bool:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "is_dir", fail)
    with pytest.raises(QsgmError, match=r"cannot look into .*: permission denied"):
        paths.bundle_folder(tmp_path)


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
