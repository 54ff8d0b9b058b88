"""What the commands say: results to stdout, progress and complaints to stderr."""

import importlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)
from rich.progress import Progress as Bars

from qsgm import paths
from qsgm.errors import QsgmError, as_text
from qsgm.progress import NO_FIGURES, Progress, ignore

if TYPE_CHECKING:
    from qsgm.bundle import Bundle

# library: the extra that brings it
HOST_LIBRARIES = {"torch": "train", "onnx": "train", "matplotlib": "report"}
LEAST_COLUMNS, MOST_COLUMNS = 40, 1000


def tell(what: str, path: Path) -> None:
    """Where something has been written."""
    typer.echo(f"{what}: {as_text(str(path), 5000)}")


def tell_or_print(what: str, path: Path, values: dict[str, Any], as_json: bool) -> None:
    """Where something has been written, or, for machines, all that is worth knowing of it."""
    if as_json:
        print_json(values)
    else:
        tell(what, path)


def terminal(*, stderr: bool = False) -> Console:
    """A stream to draw on, of a width that something fits into: COLUMNS may say anything."""
    console = Console(stderr=stderr)
    console.width = min(max(console.width, LEAST_COLUMNS), MOST_COLUMNS)
    return console


def check_output(output: Path | None, *inputs: Path) -> None:
    """Refuse to write over what a command reads.

    Raises:
        QsgmError: `output` is one of the inputs, however it is spelt.
    """
    for path in inputs:
        with suppress(OSError, ValueError):
            if output is not None and output.samefile(path):
                raise QsgmError(f"will not write over {output}: it is an input; pass another name")


def show(values: dict[str, Any], table: RenderableType, as_json: bool) -> None:
    """A table for people, or JSON for programs."""
    if as_json:
        print_json(values)
    else:
        terminal().print(table)


def print_json(values: dict[str, Any]) -> None:
    """One JSON object on stdout."""
    from qsgm.tables import to_json

    typer.echo(to_json(values))


def write_report(values: dict[str, Any], path: Path | None) -> None:
    """Write the JSON to a file, if one was asked for."""
    from qsgm.files import write_text_atomic
    from qsgm.tables import to_json

    if path is not None:
        write_text_atomic(path, to_json(values) + "\n")


def check_picture(path: Path | None) -> None:
    """Raise QsgmError where a picture is asked for that cannot be drawn, before hours of work."""
    if path is not None:
        host_module("matplotlib")


def draw(chart: str, values: dict[str, Any], path: Path | None) -> None:
    """Write one of the charts of :mod:`qsgm.bench.charts` as a PNG file, if it was asked for."""
    from qsgm.bench import charts

    if path is not None:
        charts.write_chart(getattr(charts, chart)(values), path)


def open_bundle(folder: Path | None) -> "Bundle":
    """The bundle asked for, or the shipped one."""
    from qsgm.bundle import load_bundle

    return load_bundle(paths.bundle_folder(folder))


def host_module(name: str) -> Any:
    """A module of the host side, or one line saying what it takes."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing not in HOST_LIBRARIES:
            raise
        raise QsgmError(
            f"this command runs on the host and needs {missing}, which is not installed: "
            f"pip install -c constraints.txt '.[{HOST_LIBRARIES[missing]}]' in a checkout"
        ) from error


@contextmanager
def progress() -> Iterator[Progress]:
    """A bar per stage on stderr, on a terminal only; yields what is told about progress."""
    console = terminal(stderr=True)
    if not console.is_terminal:  # bars that are disabled end with an empty line in rich 13
        yield ignore
        return
    columns = (
        TextColumn("{task.description:>10}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[values]}"),
    )
    tasks: dict[str, TaskID] = {}
    with Bars(*columns, console=console, transient=True) as bars:

        def watch(
            stage: str, done: int, of: int, figures: Mapping[str, float] = NO_FIGURES, /
        ) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=of, values="")
            shown = "  ".join(f"{name} {value:.4g}" for name, value in figures.items())
            bars.update(tasks[stage], completed=done, total=of, values=shown)

        yield watch
