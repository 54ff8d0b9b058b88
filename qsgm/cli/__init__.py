"""The command line. Results go to stdout, progress to stderr; errors are one line.

Exit codes: 0 done, 1 what was given cannot be used, 2 the command was called wrongly,
130 interrupted.
"""

import os
import sys
from collections.abc import Sequence
from typing import Annotated, Any, cast

import typer

from qsgm import __version__
from qsgm.cli import bench, commands
from qsgm.cli.console import complain
from qsgm.errors import QsgmError

EXIT_BAD_INPUT = 1
EXIT_INTERRUPTED = 130
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


def run(arguments: Sequence[str]) -> int:
    """Run one command line; the exit code.

    Exceptions that are nobody's fault but this program's are not caught.
    """
    try:
        command = typer.main.get_command(app)
        code = command.main(list(arguments) or ["--help"], prog_name="qsgm", standalone_mode=False)
        code = code if isinstance(code, int) else 0
    except QsgmError as error:
        complain(f"error: {error}")
        return EXIT_BAD_INPUT
    except USAGE_ERROR as error:
        usage = cast(Any, error)
        command_path = usage.ctx.command_path if usage.ctx else "qsgm"
        message = usage.format_message().rstrip(". ")
        complain(f"{command_path}: {message}; see `{command_path} --help`")
        return int(usage.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        code = EXIT_INTERRUPTED
    if code == EXIT_INTERRUPTED:  # newer versions of typer turn the exception into the code
        complain("interrupted")
    return code


def main() -> None:
    """Entry point of the installed command."""
    # numpy's products and OpenCV's warps are small here: threads of their own double a frame's CPU
    # time and save none. Neither is imported yet; settings of the user's own stay.
    for variable in ("OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
        os.environ.setdefault(variable, "1")
    sys.exit(run(sys.argv[1:]))
