"""`qsgm objects`: this user's taught objects, listed, shown, removed, renamed, copied out."""

import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from qsgm.cli.console import check_output, show, tell_or_print
from qsgm.cli.options import JsonOption
from qsgm.cli.streams import complain
from qsgm.errors import QsgmError, as_text

if TYPE_CHECKING:
    from rich.console import RenderableType

    from qsgm.store import StoredObject

app = typer.Typer(help="This user's taught objects and tuned networks.")
NameArgument = Annotated[
    Path, typer.Argument(metavar="NAME", help="An object's name, or its folder.")
]


@app.command("list")
def list_objects(as_json: JsonOption = False) -> None:
    """List them: when and on what each was taught, and whether it can be used."""
    from qsgm import paths
    from qsgm.store import stored_objects

    found = stored_objects()
    values = {
        "folder": str(paths.objects_folder()),
        "objects": [one.to_json() for one in found],
    }
    show(values, _listing(found), as_json)


@app.command("show")
def show_object(name: NameArgument, as_json: JsonOption = False) -> None:
    """Show all that one of them says of itself."""
    from qsgm.store import find_object, stored_object
    from qsgm.tables import table

    values = stored_object(find_object(name, names_first=True)).details_json()
    flat = {key: value for key, value in values.items() if key not in ("versions", "made", "heads")}
    rows = [(key.replace("_", " "), as_text(str(value), 5000)) for key, value in flat.items()]
    rows += [(f"head: {as_text(one['name'])}", head_told(one)) for one in values.get("heads", ())]
    rows += [(f"made: {key}", as_text(str(value), 5000)) for key, value in values["made"].items()]
    shown = table(None, ("", ""), rows, left=(0, 1))
    for column in shown.columns:
        column.no_wrap, column.overflow = False, "fold"
    shown.show_header = False
    show(values, shown, as_json)


@app.command("remove")
def remove(
    name: NameArgument,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Remove one of them for good: its network, its patch, its report."""
    from qsgm.store import check_object, find_object, remove_object

    folder = find_object(name, names_first=True)
    check_object(folder)
    if not yes and not _agreed(f"remove {as_text(str(folder), 5000)} for good?"):
        raise QsgmError(f"{folder} stays: nobody said yes; pass --yes to remove it")
    remove_object(folder)
    tell_or_print("removed", folder, {"removed": str(folder)}, as_json)


@app.command("rename")
def rename(
    name: NameArgument,
    new: Annotated[str, typer.Argument(metavar="NEW", help="In any script.")],
    as_json: JsonOption = False,
) -> None:
    """Give one of them another name."""
    from qsgm.store import find_object, rename_object

    old = find_object(name, names_first=True)
    folder = rename_object(old, new)
    values = {"renamed": str(old), "name": new, "folder": str(folder)}
    tell_or_print(f"{new} is now", folder, values, as_json)


@app.command("export")
def export(
    name: NameArgument,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE.onnx")],
    as_json: JsonOption = False,
) -> None:
    """Copy its graph out: a plain ONNX file, frame in, heatmap out.

    --json says what reading the answers takes: what to scale frames by, how far to mirror them
    beyond their border, the angle to subtract; of a network of your own its inputs and heads.
    """
    from qsgm.files import write_bytes_atomic
    from qsgm.store import find_object, graph_of

    if output.suffix.lower() != ".onnx":
        raise QsgmError(f"cannot write {output}: a graph is ONNX; pass a name that ends in .onnx")
    folder = find_object(name, names_first=True)
    check_output(output, *folder.glob("*"))
    network, values = graph_of(folder)
    write_bytes_atomic(output, network)
    tell_or_print("graph", output, values | {"output": str(output)}, as_json)


def head_told(head: dict[str, Any]) -> str:
    """A head in a few words."""
    channels = head["channels"]
    return f"{head['kind']}, {channels} channel{'s' * (channels > 1)}, {head['activation']}"


def _agreed(question: str) -> bool:
    complain(f"{question} [y/N]")  # not by typer, which writes to stdout as well
    with suppress(OSError, ValueError):  # nobody can be heard
        return sys.stdin is not None and sys.stdin.readline().strip().lower() in ("y", "yes")
    return False


def _listing(found: "list[StoredObject]") -> "RenderableType":
    from rich.console import Group
    from rich.text import Text

    from qsgm.tables import CLOSE, table

    if not found:
        return Text("no objects yet: run `qsgm finetune object.png`")
    rows, problems = [], []
    for one in found:
        values = one.to_json()
        taught, bundle = values["taught"] or "-", values["bundle_sha256"]
        own = "" if values["task"] in (None, "grasp") else f" ({values['task']})"
        name = f"{one.name}{own} *" if one.last else f"{one.name}{own}"
        size, patch = f"{values['bytes'] / 1000:.0f} KB", "yes" if values["patch"] else "no"
        scale = None if values["scale"] is None else f"{values['scale']:.2f}"
        when = taught[:16].replace("T", " ")
        hashed, version = bundle and bundle[:8], values["versions"]["qsgm"]
        rows.append((name, when, values["frames"], scale, size, patch, hashed, version))
        problems += [Text(f"{one.name}: {one.problem}", style="yellow")] if one.problem else []
    columns = ("object", "taught", "frames", "scale", "size", "patch", "bundle", "qsgm")
    notes = [Text("* what `qsgm predict` looks for by itself", style="dim")]
    listed = table(None, columns, rows, left=(0, 1), padding=CLOSE)
    # A long name takes two lines and leaves the other columns whole.
    first = listed.columns[0]
    first.no_wrap, first.overflow, first.min_width = False, "fold", 12
    return Group(listed, *(notes if any(one.last for one in found) else ()), *problems)
