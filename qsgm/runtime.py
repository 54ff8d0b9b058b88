"""Stock ONNX Runtime sessions with this project's settings."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import onnxruntime as ort
from numpy.typing import NDArray
from onnxruntime.capi import onnxruntime_pybind11_state as ort_native

from qsgm.errors import QsgmError

_CONFIG = {
    # Spinning threads starve whatever else runs on a small device, and buy nothing at this size.
    "session.intra_op.allow_spinning": "0",
    "session.inter_op.allow_spinning": "0",
}
_NONE: Mapping[str, NDArray[Any]] = MappingProxyType({})
# What a graph raises when it runs: ONNX Runtime's own types have no common one, and its Python
# side raises ValueError (an input is missing) and RuntimeError (a name is unknown).
_RUN_ERRORS: tuple[type[Exception], ...] = (
    ValueError,
    RuntimeError,
    *(
        kind
        for kind in vars(ort_native).values()
        if isinstance(kind, type) and issubclass(kind, Exception)
    ),
)


def session_options(threads: int = 1) -> ort.SessionOptions:
    """What every session here runs with."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    for key, value in _CONFIG.items():
        options.add_session_config_entry(key, value)
    return options


def run_options(*, whole_graph: bool = True, give_memory_back: bool = False) -> ort.RunOptions:
    """How one run differs from others.

    Args:
        whole_graph: if not, nothing is computed that the outputs asked for do not need.
        give_memory_back: when it is done; the session's next run has to ask for it again.
    """
    options = ort.RunOptions()
    options.only_execute_path_to_fetches = not whole_graph
    if give_memory_back:
        options.add_run_config_entry("memory.enable_memory_arena_shrinkage", "cpu:0")
    return options


def open_session(
    model: Path | bytes, threads: int = 1, constants: Mapping[str, NDArray[Any]] = _NONE
) -> ort.InferenceSession:
    """A CPU session of an ONNX file or of its bytes.

    Args:
        model: whose external data, if it has any, lies beside its file.
        threads: for each operator.
        constants: in the place of the model's own external ones, by initializer name.

    Raises:
        QsgmError: ONNX Runtime does not accept the model.
    """
    source = model if isinstance(model, bytes) else str(model)
    try:
        options = session_options(threads)
        # Not add_initializer: that one comes after the optimizer has made constants of constants.
        values = [ort.OrtValue.ortvalue_from_numpy(array) for array in constants.values()]
        options.add_external_initializers([*constants], values)
        session = ort.InferenceSession(source, options, providers=["CPUExecutionProvider"])
        # The session may read their memory as long as it lives.
        session.constants = constants, values
        return session
    except Exception as error:  # ORT raises several unrelated types
        name = "a graph" if isinstance(model, bytes) else f"{model}"
        raise QsgmError(
            f"ONNX Runtime {ort.__version__} cannot load {name} ({_first_line(error)}); "
            "export the bundle again with `qsgm fold-and-quantize`"
        ) from error


@contextmanager
def running(what: str, advice: str) -> Iterator[None]:
    """Run graphs in this block: one that does not fit what it is given is refused in one line.

    Raises:
        QsgmError: `what` holds such a graph; the message ends with `advice`.
    """
    try:
        yield
    except _RUN_ERRORS as error:
        raise QsgmError(
            f"a graph of {what} does not fit what it is given ({_first_line(error)}); {advice}"
        ) from error


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]
