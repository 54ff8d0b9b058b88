"""All commands together, as typer has them."""

from collections.abc import Sequence
from typing import Annotated, Any, cast

import typer

from qsgm import __version__
from qsgm.cli import bench, commands, objects, watching
from qsgm.cli.streams import complain

EXIT_ABORTED = 130
# UsageError; typer keeps it in another place in every other version.
USAGE_ERROR = cast(type[Exception], typer.BadParameter.__base__)
app = typer.Typer(
    name="qsgm",
    help="Fine-tune a network on the device, feed-forward, with int8 synthetic gradients.",
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.add_typer(commands.app)
app.add_typer(watching.app)
app.add_typer(objects.app, name="objects")
app.add_typer(bench.app, name="bench")


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"qsgm {__version__}")
        raise typer.Exit


@app.callback()
def common(
    _version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    """Fine-tune a network on the device, feed-forward, with int8 synthetic gradients."""


def call(arguments: Sequence[str]) -> int:
    """Run one command line; the exit code. What the commands raise is the caller's."""
    try:
        command = typer.main.get_command(app)
        code = command.main(list(arguments) or ["--help"], prog_name="qsgm", standalone_mode=False)
        return code if isinstance(code, int) else 0
    except USAGE_ERROR as error:
        usage = cast(Any, error)
        command_path = usage.ctx.command_path if usage.ctx else "qsgm"
        message = usage.format_message().rstrip(". ")
        complain(f"{command_path}: {message}; see `{command_path} --help`")
        return int(usage.exit_code)
    except typer.Abort:
        return EXIT_ABORTED
