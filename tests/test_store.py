"""Taught objects: found by name, listed, shown, removed and renamed whole or not at all."""

import json
import shutil
from pathlib import Path

import pytest
from command_line import Run, assert_refused
from toy_objects import both_on_a_table, hook, teach
from toys import toy

from qsgm import QsgmError, files, load_object, paths, store
from qsgm.images import write_png
from qsgm.manifest import NETWORK
from qsgm.store import find_object, remove_object, rename_object, stored_objects


@pytest.fixture
def mug() -> Path:
    """One object of this user's, the last one."""
    folder = teach(paths.folder_named("mug"), "mug", toy())
    paths.remember_object(folder)
    return folder


def files_of(folder: Path) -> dict[str, bytes]:
    return {one.name: one.read_bytes() for one in folder.iterdir()}


def names() -> list[str]:
    return [one.name for one in stored_objects()]


def test_a_user_without_objects_is_told_how_to_get_one(qsgm: Run) -> None:
    assert "no objects yet: run `qsgm finetune" in qsgm("objects", "list").out
    assert qsgm("objects", "list", "--json").json["objects"] == []


def test_an_object_is_listed_with_what_it_was_made_of(qsgm: Run, mug: Path) -> None:
    (one,) = qsgm("objects", "list", "--json").json["objects"]
    assert one["taught"].startswith("20")
    assert {key: value for key, value in one.items() if key != "taught"} == {
        "name": "mug",
        "task": "grasp",
        "folder": str(mug),
        "frames": 2,
        "scale": 1.0,
        "bytes": sum(len(data) for data in files_of(mug).values()),
        "patch": True,
        "bundle_sha256": "c0ffee" * 8,
        "versions": {"qsgm": "0.1.0", "onnxruntime": "1", "opencv": "5", "numpy": "2"},
        "last": True,
        "problem": None,
    }
    row = next(line for line in qsgm("objects", "list").out.splitlines() if "mug" in line)
    assert row.split()[:2] == ["mug", "*"]
    assert row.split()[4:] == ["2", "1.00", *row.split()[6:8], "yes", "c0ffeec0", "0.1.0"]


def test_a_damaged_object_is_listed_with_what_is_wrong_and_can_be_removed(
    qsgm: Run,
    mug: Path,
) -> None:
    (mug / NETWORK).write_bytes(b"x")
    (one,) = qsgm("objects", "list", "--json").json["objects"]
    assert "network.onnx is altered" in one["problem"]
    assert "network.onnx is altered" in qsgm("objects", "list").out.replace("\n", "")
    assert_refused(qsgm("objects", "show", "mug"), 1, "network.onnx is altered")
    assert_refused(qsgm("objects", "rename", "mug", "cup"), 1, "network.onnx is altered")
    assert [one.name for one in mug.parent.iterdir()] == ["mug"]
    assert qsgm("objects", "remove", "mug", "--yes").code == 0
    assert names() == []


@pytest.mark.parametrize(
    "made", [{"frames_sha256": 3, "qsgm": [1], "seed": float("nan"), "x": float("inf")}, {}]
)
def test_provenance_that_says_nonsense_is_not_shown(
    qsgm: Run, mug: Path, made: dict[str, object]
) -> None:
    path = mug / "object.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"made": made}))
    values = stored_objects()[0].to_json()
    assert (values["frames"], values["versions"]["qsgm"]) == (None, None)
    assert qsgm("objects", "show", "mug", "--json").json["made"]["seed"] is None


def test_show_says_what_reading_the_graph_takes(qsgm: Run, mug: Path) -> None:
    values = qsgm("objects", "show", "mug", "--json").json
    assert (values["encoding"], values["offset_deg"], values["views"]) == ("double", 0.0, 1)
    assert values["made"]["seed"] == 0
    assert str(mug)[-20:] in qsgm("objects", "show", mug).out.replace("\n", "").replace(" ", "")


def test_what_is_shown_starts_at_the_left(qsgm: Run, mug: Path) -> None:
    lines = [line for line in qsgm("objects", "show", mug).out.splitlines() if line.strip()]
    starts = {len(line) - len(line.lstrip()) for line in lines if "  made: " in line}
    assert starts == {2}


def test_an_object_is_found_by_name_or_folder_and_without_its_bundle(
    qsgm: Run,
    mug: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def gone(*_: object) -> Path:
        raise AssertionError("the bundle was looked for")

    monkeypatch.setattr(paths, "bundle_folder", gone)
    write_png(tmp_path / "scene.png", both_on_a_table())
    scene = tmp_path / "scene.png"
    by_name = qsgm("predict", "--json", "--object", "mug", scene).json
    assert by_name["found"]
    assert by_name == qsgm("predict", "--json", "--object", mug, scene).json
    assert by_name == qsgm("predict", "--json", scene).json


def test_a_folder_comes_before_a_name_for_predict_and_after_it_for_objects(
    mug: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mug").mkdir()
    assert find_object(Path("mug")) == mug  # what is there is no object
    shutil.copytree(mug, "mug", dirs_exist_ok=True)
    assert find_object(Path("mug")) == Path("mug")
    assert find_object(Path("mug"), names_first=True) == mug


def test_a_name_of_nothing_is_refused_with_the_way_out(qsgm: Run) -> None:
    for command in (("predict", "x.png", "--object", "cup"), ("objects", "show", "cup")):
        assert_refused(qsgm(*command), 1, "no object cup", "`qsgm objects list`")


@pytest.mark.parametrize("answer", ["n\n", ""])
def test_removing_asks_and_without_a_yes_nothing_is_removed(
    qsgm: Run,
    mug: Path,
    answer: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    (tmp_path / "answer").write_text(answer)
    before = files_of(mug)
    with (tmp_path / "answer").open() as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        outcome = qsgm("objects", "remove", "mug")
    assert (outcome.code, outcome.out) == (1, "")
    assert "for good?" in outcome.err
    assert "nobody said yes; pass --yes" in outcome.err
    assert files_of(mug) == before


def test_a_removed_object_is_gone_and_no_longer_the_last(qsgm: Run, mug: Path) -> None:
    assert qsgm("objects", "remove", "mug", "--yes", "--json").json == {"removed": str(mug)}
    assert list(mug.parent.iterdir()) == []
    teach(mug, "mug", hook())  # another one of that name was not used last
    with pytest.raises(QsgmError, match="no object was tuned here yet"):
        paths.last_object_folder()


def test_an_object_in_a_folder_needs_no_home(
    qsgm: Run, mug: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = shutil.copytree(mug, tmp_path / "mug")
    for name in ("XDG_DATA_HOME", "HOME"):
        monkeypatch.setenv(name, "")
    assert not qsgm("objects", "show", folder, "--json").json["last"]
    assert qsgm("objects", "remove", "--yes", folder).code == 0
    assert not folder.exists()
    assert_refused(qsgm("objects", "list"), 1, "no home folder")


def test_removing_another_object_leaves_the_last_one_remembered(mug: Path) -> None:
    remove_object(teach(paths.folder_named("cup"), "cup", hook()))
    assert paths.last_object_folder() == mug


def test_what_is_no_object_or_holds_something_else_is_not_removed(
    qsgm: Run,
    mug: Path,
    tmp_path: Path,
) -> None:
    (tmp_path / "photos").mkdir()
    assert_refused(
        qsgm("objects", "remove", "--yes", tmp_path / "photos"), 1, "no object: expected a folder"
    )
    (mug / "notes.txt").write_text("mine")
    assert_refused(qsgm("objects", "remove", "--yes", "mug"), 1, "did not write 'notes.txt'")
    assert (mug / "notes.txt").read_text() == "mine"
    assert load_object(mug).description.name == "mug"


def test_of_a_link_to_an_object_the_link_alone_is_removed(mug: Path, tmp_path: Path) -> None:
    kept = shutil.move(mug, tmp_path / "kept")
    mug.symlink_to(kept)
    remove_object(mug)
    assert not mug.is_symlink()
    assert load_object(Path(kept)).description.name == "mug"


def test_a_removal_that_fails_leaves_the_object_whole(
    mug: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: Path) -> None:
        raise OSError(28, "No space left on device")

    before = files_of(mug)
    monkeypatch.setattr(files, "_make_folder", full)
    with pytest.raises(QsgmError, match="no space left"):
        remove_object(mug)
    assert files_of(mug) == before


@pytest.mark.parametrize("name", ["cup", "чашка", "茶碗 2", "[bold]", "..", "a" * 200])
def test_a_renamed_object_answers_to_its_new_name_in_any_script(
    qsgm: Run,
    mug: Path,
    name: str,
) -> None:
    outcome = qsgm("objects", "rename", "mug", name, "--json")
    if name == "..":
        assert_refused(outcome, 1, "'..' cannot be a name")
        return
    folder = Path(outcome.json["folder"])
    assert names() == [name]
    assert find_object(Path(name)) == folder == paths.last_object_folder()
    assert load_object(folder).description.name == name
    assert not mug.exists()
    listed = qsgm("objects", "list").out
    assert "".join(name.split()) in "".join(line[:14] for line in listed.splitlines()).replace(
        " ", ""
    )


def test_renaming_keeps_all_but_the_name(mug: Path) -> None:
    before, taught = files_of(mug), stored_objects()[0].to_json()["taught"]
    after = files_of(rename_object(mug, "cup"))
    assert after.keys() == before.keys()
    changed = {name for name in after if after[name] != before[name]}
    assert changed == {"object.json", "SHA256SUMS"}
    old, new = (json.loads(one["object.json"]) for one in (before, after))
    assert new == old | {"name": "cup"}
    assert stored_objects()[0].to_json()["taught"] == taught


@pytest.mark.parametrize("name", ["", "  ", "a/b", "a\nb", "n" * 201])
def test_a_name_that_nobody_could_say_is_refused(mug: Path, name: str) -> None:
    with pytest.raises(QsgmError, match="cannot be a name"):
        rename_object(mug, name)


def test_renaming_never_overwrites(mug: Path) -> None:
    cup = teach(paths.folder_named("cup"), "cup", hook())
    before = files_of(mug), files_of(cup)
    for name in ("cup", "mug"):
        with pytest.raises(QsgmError, match="already; pass another name"):
            rename_object(mug, name)
    assert (files_of(mug), files_of(cup)) == before


def test_an_object_that_appears_while_another_is_renamed_to_it_stays(
    mug: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As by a `finetune` in another process, after the check."""
    read = store.read_object

    def meanwhile(folder: Path) -> object:
        teach(paths.folder_named("cup"), "cup", hook())
        return read(folder)

    monkeypatch.setattr(store, "read_object", meanwhile)
    with pytest.raises(QsgmError, match="cannot write"):
        rename_object(mug, "cup")
    assert names() == ["cup", "mug"]
    assert paths.last_object_folder() == mug


def test_a_rename_that_is_interrupted_leaves_the_object_under_a_name(
    mug: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(store, "remove_folder", interrupted)
    with pytest.raises(KeyboardInterrupt):
        rename_object(mug, "cup")
    assert names() == ["cup", "mug"]  # both, each whole
    assert all(one.problem is None for one in stored_objects())
    assert load_object(paths.last_object_folder()).description.name == "cup"


def test_an_exported_graph_is_the_network_and_comes_with_what_reading_it_takes(
    qsgm: Run,
    mug: Path,
    tmp_path: Path,
) -> None:
    output = tmp_path / "mug.onnx"
    values = qsgm("objects", "export", "mug", "-o", output, "--json").json
    assert output.read_bytes() == (mug / NETWORK).read_bytes()
    assert values == {
        "object": "mug",
        "scale": 1.0,
        "encoding": "double",
        "offset_deg": 0.0,
        "margin_px": 48,
        "output": str(output),
    }
    png = qsgm("objects", "export", "mug", "-o", tmp_path / "mug.png")
    assert_refused(png, 1, "ends in .onnx")
    own = qsgm("objects", "export", "mug", "-o", mug / NETWORK)
    assert_refused(own, 1, "will not write over")
