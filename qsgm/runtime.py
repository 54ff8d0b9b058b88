"""Stock ONNX Runtime sessions with this project's settings."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any

import onnxruntime as ort
from numpy.typing import NDArray
from onnxruntime.capi import onnxruntime_pybind11_state as ort_native

from qsgm.errors import QsgmError, as_text
from qsgm.external_data import check_external_data

# A value's type as ONNX Runtime names it, and its shape; None for a side of any length.
Value = tuple[str, Sequence[int | None]]

_CONFIG = {
    # Not by looking at the bytes: the other format is not the one that was checked.
    "session.load_model_format": "ONNX",
    # Spinning threads starve whatever else runs on a small device, and buy nothing at this size.
    "session.intra_op.allow_spinning": "0",
    "session.inter_op.allow_spinning": "0",
}
_NO_ARRAYS: Mapping[str, NDArray[Any]] = MappingProxyType({})
_NO_FILES: Mapping[str, bytes] = MappingProxyType({})
# What a graph raises when it runs: ONNX Runtime's own types have no common one, and its Python
# side raises ValueError (an input is missing) and RuntimeError (a name is unknown).
_RUN_ERRORS: tuple[type[Exception], ...] = (
    ValueError,
    RuntimeError,
    MemoryError,
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
    options.log_severity_level = 4  # what it would say of an error is in the exception
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
    model: bytes,
    threads: int = 1,
    constants: Mapping[str, NDArray[Any]] = _NO_ARRAYS,
    files: Mapping[str, bytes] = _NO_FILES,
    name: str = "a graph",
) -> ort.InferenceSession:
    """A CPU session of an ONNX file's bytes; no file is opened for it.

    Args:
        model: an ONNX file's content.
        threads: for each operator.
        constants: in the place of the model's own external ones, by initializer name.
        files: in which the model keeps numbers, by name; it may name no others.
        name: of the model, for the message.

    Raises:
        QsgmError: ONNX Runtime does not accept the model, or it names other files.
    """
    try:
        check_external_data(model, files)
        options = session_options(threads)
        # Not add_initializer: that one comes after the optimizer has made constants of constants.
        values = [ort.OrtValue.ortvalue_from_numpy(array) for array in constants.values()]
        options.add_external_initializers([*constants], values)
        contents = [*files.values()]
        options.add_external_initializers_from_files_in_memory(
            [*files], contents, [len(content) for content in contents]
        )
        session = ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        # The session may read their memory as long as it lives.
        session.constants = constants, values, contents
        return session
    except Exception as error:  # ORT raises several unrelated types
        raise QsgmError(
            f"ONNX Runtime {ort.__version__} cannot load {name} ({_first_line(error)}); "
            "export the bundle again with `qsgm fold-and-quantize`"
        ) from error


def check_interface(
    session: ort.InferenceSession,
    name: str,
    inputs: Mapping[str, Value],
    outputs: Mapping[str, Value],
    advice: str,
) -> None:
    """Refuse a graph that takes anything else than these inputs, or lacks one of these outputs.

    Raises:
        QsgmError: says what the graph called `name` takes or gives; ends with `advice`.
    """
    for verb, wanted, values in (
        ("takes", inputs, session.get_inputs()),
        ("gives", outputs, session.get_outputs()),
    ):
        there = {value.name: (value.type, value.shape) for value in values}
        other = {
            key for key in wanted if key not in there or not _fits(there[key], wanted[key])
        } | (there.keys() - wanted.keys() if verb == "takes" else set())
        if other:
            got, expected = (
                as_text(str({key: some[key] for key in some if key in other}))
                for some in (there, wanted)
            )
            raise QsgmError(f"{name} {verb} {got}, expected {expected}; {advice}")


def _fits(got: Value, wanted: Value) -> bool:
    """Whether the types are the same, and the shapes where both say a number."""
    (kind, shape), (wanted_kind, wanted_shape) = got, wanted
    return (
        kind == wanted_kind
        and len(shape) == len(wanted_shape)
        and all(
            expected in (side, None) or not isinstance(side, int)
            for side, expected in zip(shape, wanted_shape, strict=True)
        )
    )


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
    return next(iter(str(error).splitlines()), type(error).__name__)[:200]
