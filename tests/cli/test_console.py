"""What every command shares: usage errors, exit codes, single lines, interrupts."""

import subprocess
import sys
from pathlib import Path

import cv2
import pytest
from command_line import Run, assert_refused, in_a_process, predict_into

from qsgm import __version__, cli
from qsgm.cli import app, commands, console
from qsgm.tune import run as tuning

USAGE_ERRORS = [
    ("--layers", "99"),
    ("--layers", "0"),
    ("--epochs", "-1"),
    ("--epochs", "many"),
    ("--seed", "abc"),
    ("--seed", "-1"),
    ("--seed", "2147483648"),
    ("--center", "5"),
    ("--center", "5,x"),
    ("--center", "1,2,3"),
    ("--method", "magic"),
    ("--optimizer", "lion"),
    ("--threads", "0"),
    ("--no-such-option", "1"),
]


@pytest.mark.parametrize(("option", "value"), USAGE_ERRORS)
def test_a_value_out_of_range_is_a_usage_error_in_one_line(
    qsgm: Run, option: str, value: str, frame_path: Path, bundle_folder: Path, tmp_path: Path
) -> None:
    before = sorted(tmp_path.rglob("*"))
    outcome = qsgm("finetune", option, value, "--bundle", bundle_folder, frame_path)
    assert_refused(outcome, 2, option, "see `qsgm finetune --help`")
    assert sorted(tmp_path.rglob("*")) == before


def test_no_frame_at_all_is_a_usage_error(qsgm: Run) -> None:
    assert_refused(qsgm("finetune"), 2)
    assert_refused(qsgm("predict", "a.png", "b.png"), 2)


def test_an_unknown_command_is_a_usage_error(qsgm: Run) -> None:
    assert_refused(qsgm("fine-tune"), 2, "fine-tune", "see `qsgm --help`")


def test_a_bug_is_not_hidden(qsgm: Run, monkeypatch: pytest.MonkeyPatch, frame_path: Path) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(commands, "open_bundle", broken)
    with pytest.raises(ZeroDivisionError):
        qsgm("finetune", frame_path)


def test_the_progress_says_nothing_unless_it_is_on_a_terminal(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with console.progress() as watch:
        watch("crops", 1, 2)
        watch("meta", 1, 2, {"loss": 0.5})
    assert capsys.readouterr() == ("", "")


def test_on_a_terminal_the_progress_is_on_stderr(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich takes any stream for a terminal then
    monkeypatch.setenv("TERM", "xterm")
    with console.progress() as watch:
        watch("crops", 1, 2)
    out, err = capsys.readouterr()
    assert out == ""
    assert "crops" in err


def test_the_version_and_the_help_are_printed(qsgm: Run) -> None:
    assert qsgm("--version").out == f"qsgm {__version__}\n"
    assert "finetune" in qsgm("--help").out
    assert "finetune" in qsgm().out
    for command in ("finetune", "predict", "fidelity", "pretrain", "fold-and-quantize"):
        assert qsgm(command, "--help").code == 0


def test_exit_codes_and_single_lines_hold_in_a_process_of_its_own(
    bundle_folder: Path, tmp_path: Path
) -> None:
    path = tmp_path / "empty.png"
    path.write_bytes(b"")
    outcome = in_a_process("finetune", "--bundle", bundle_folder, path)
    assert_refused(outcome, 1, "empty.png")
    assert_refused(in_a_process("finetune", "--layers", 99, path), 2, "--layers")


def test_json_is_all_there_is_on_stdout_of_a_process(
    bundle_folder: Path, frame_path: Path, tmp_path: Path
) -> None:
    outcome = in_a_process(
        "finetune", "--json", "--epochs", 1, "--bundle", bundle_folder,
        "-o", tmp_path / "bar", frame_path,
    )  # fmt: skip
    assert outcome.json["object"] == "bar"
    assert outcome.err == ""


def test_an_interrupt_exits_with_130_and_writes_nothing(
    qsgm: Run,
    bundle_folder: Path,
    frame_path: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    before = sorted(tmp_path.rglob("*"))
    monkeypatch.setattr(tuning, "run_epochs", interrupted)
    outcome = qsgm("finetune", "--bundle", bundle_folder, "-o", tmp_path / "out", frame_path)
    assert (outcome.code, outcome.out, outcome.err) == (130, "", "interrupted\n")
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
@pytest.mark.parametrize("options", ["", "--json", "--help"])
def test_a_full_disk_behind_stdout_is_one_line(
    taught: Path, frame_path: Path, options: str
) -> None:
    outcome = predict_into(taught, frame_path, f"{options} >/dev/full")
    assert_refused(outcome, 1, "cannot write to standard output: no space left on device")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
def test_standard_output_says_how_much_it_took_also_once_it_cannot_be_written_to() -> None:
    code = (
        "import contextlib, sys; from qsgm.cli.streams import use_streams; use_streams()\n"
        "with contextlib.suppress(Exception): print(sys.stdout.buffer.write(b'x' * 200_000), "
        "file=sys.stderr)\n"
        "print(sys.stdout.buffer.write(b'more'), file=sys.stderr)"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("x" * 200_000 + "more", "200000\n4\n")
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=True)
    assert done.stderr == "4\n"


@pytest.mark.parametrize("streams", [">&-", "<&- >&- 2>&-"])
def test_closed_streams_are_nobodys_and_no_files(
    taught: Path, frame_path: Path, tmp_path: Path, streams: str
) -> None:
    outcome = predict_into(taught, frame_path, f"-o {tmp_path}/picture.png {streams}")
    assert (outcome.code, outcome.err) == (0, "")
    assert cv2.imread(str(tmp_path / "picture.png")) is not None


@pytest.mark.parametrize("encoding", ["ascii", "utf-8"])
def test_a_table_is_printed_in_any_encoding(taught: Path, frame_path: Path, encoding: str) -> None:
    outcome = predict_into(taught, frame_path, "", PYTHONIOENCODING=encoding, PYTHONUTF8="0")
    assert (outcome.code, outcome.err) == (0, "")
    assert "quality" in outcome.out


@pytest.mark.parametrize("columns", ["0", "100000000000"])
def test_a_table_is_printed_whatever_columns_says(
    taught: Path, frame_path: Path, columns: str
) -> None:
    outcome = predict_into(taught, frame_path, "", COLUMNS=columns)
    assert (outcome.code, outcome.err) == (0, "")
    assert "quality" in outcome.out


def test_an_interrupt_that_became_another_error_while_modules_loaded_is_an_interrupt(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(_: object) -> int:
        raise ImportError("numpy.core.multiarray failed to import")

    monkeypatch.setattr(app, "call", broken)
    for signals, code in (((2,), 130), ((15,), 143), ((1,), 129)):
        assert cli.run(["predict"], signals) == code
        assert capsys.readouterr().err == "interrupted\n"


@pytest.mark.parametrize(
    "error",
    [
        ImportError("libGL.so.1: cannot open shared object file", name="cv2"),
        ImportError("libGL.so.1: cannot open shared object file"),
        ModuleNotFoundError("No module named 'onnxruntime'", name="onnxruntime"),
        AttributeError("module 'cv2' has no attribute 'imdecode'", obj=cv2),
    ],
)
def test_a_broken_installation_is_one_line(
    error: Exception, monkeypatch: pytest.MonkeyPatch, qsgm: Run
) -> None:
    def broken(_: object) -> int:
        raise error

    monkeypatch.setattr(app, "call", broken)
    assert_refused(qsgm("predict"), 1, "the installation of", "is broken", str(error))


@pytest.mark.parametrize(
    "error", [ImportError("no", name="qsgm.nothing"), AttributeError("no", obj=None)]
)
def test_a_module_of_our_own_that_is_missing_is_a_bug(
    error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_: object) -> int:
        raise error

    monkeypatch.setattr(app, "call", broken)
    with pytest.raises(type(error)):
        cli.run(["predict"])


def test_a_program_without_a_stdout_ends_well(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdout", None)
    assert cli.run(["objects", "list", "--json"]) == 0
