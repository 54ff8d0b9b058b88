"""The command line. Results go to stdout, progress to stderr; errors are one line.

Exit codes: 0 done, 1 what was given cannot be used, 2 the command was called wrongly; 130
interrupted, 143 terminated, 129 hung up, 141 whoever read stdout has gone.
"""

import os
import signal
import sys
from collections.abc import Sequence

from qsgm.cli.streams import complain, use_streams
from qsgm.errors import QsgmError

EXIT_BAD_INPUT = 1
EXIT_BY_SIGNAL = 128
EXIT_INTERRUPTED = EXIT_BY_SIGNAL + signal.SIGINT
_LIBRARIES = ("cv2", "numpy", "onnxruntime", "rich", "typer")
_REQUESTS = ("SIGINT", "SIGTERM", "SIGHUP")  # to end; not every system knows them all


def run(arguments: Sequence[str], signals: Sequence[int] = ()) -> int:
    """Run one command line; the exit code.

    Exceptions that are nobody's fault but this program's are not caught.

    Args:
        arguments: without the program's name.
        signals: grows by those that come while it runs.
    """
    try:
        # Here, so that what goes wrong while modules load is one line as well.
        from qsgm.cli.app import call

        code = call(arguments)
        if sys.stdout is not None:
            sys.stdout.flush()
    except KeyboardInterrupt:
        code = EXIT_INTERRUPTED
    except Exception as error:
        # Some libraries make an ImportError of an interrupt.
        code = EXIT_INTERRUPTED if signals else _explained(error)
    if code == EXIT_INTERRUPTED:  # newer versions of typer turn the exception into the code
        complain("interrupted")
        code = EXIT_BY_SIGNAL + signals[0] if signals else code
    return code


def _explained(error: Exception) -> int:
    """One line on what the user can mend; raises what is this program's own fault."""
    culprit = getattr(error, "obj", None) if isinstance(error, AttributeError) else error
    name = str(getattr(culprit, "name", None) or getattr(culprit, "__name__", None) or "")
    package = name.partition(".")[0]
    if isinstance(error, QsgmError):
        complain(f"error: {error}")
    elif package in _LIBRARIES or (isinstance(error, ImportError) and package != "qsgm"):
        first = next(iter(str(error).splitlines()), "no reason given")
        complain(
            f"error: the installation of {name or 'a library'} is broken ({first}); install qsgm "
            "and what it needs again, in a new environment"
        )
    else:
        raise error
    return EXIT_BAD_INPUT


def main() -> None:
    """Entry point of the installed command."""
    signals: list[int] = []
    known = [number for name in _REQUESTS if (number := getattr(signal, name, None)) is not None]
    caught = [number for number in known if signal.getsignal(number) != signal.SIG_IGN]

    def end(number: int, _frame: object) -> None:
        for one in caught:  # who asks twice does not want to wait
            signal.signal(one, signal.SIG_DFL)
        signals.append(number)
        raise KeyboardInterrupt

    for number in caught:
        signal.signal(number, end)
    use_streams()
    # numpy's products and OpenCV's warps are small here: threads of their own double a frame's CPU
    # time and save none. Neither is imported yet; settings of the user's own stay.
    for variable in ("OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
        os.environ.setdefault(variable, "1")
    code = run(sys.argv[1:], signals)
    for number in caught:  # the rest is the interpreter's, which would show a traceback
        signal.signal(number, signal.SIG_DFL)
    sys.exit(code)
