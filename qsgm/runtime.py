"""Stock ONNX Runtime sessions with this project's settings."""

from pathlib import Path

import onnxruntime as ort

from qsgm.errors import QsgmError

# Spinning threads starve whatever else runs on a small device, and buy nothing at this size.
_NO_SPINNING = {
    "session.intra_op.allow_spinning": "0",
    "session.inter_op.allow_spinning": "0",
}


def open_session(model: Path | bytes, threads: int = 1) -> ort.InferenceSession:
    """A CPU session of an ONNX file or of its bytes.

    Raises:
        QsgmError: ONNX Runtime does not accept the model.
    """
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    for key, value in _NO_SPINNING.items():
        options.add_session_config_entry(key, value)
    source = model if isinstance(model, bytes) else str(model)
    try:
        return ort.InferenceSession(source, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ORT raises several unrelated types
        name = "a graph" if isinstance(model, bytes) else f"{model}"
        reason = str(error).splitlines()[0][:200]
        raise QsgmError(
            f"ONNX Runtime {ort.__version__} cannot load {name} ({reason}); "
            "export the bundle again with `qsgm fold-and-quantize`"
        ) from error
