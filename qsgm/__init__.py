"""Fine-tune a network on the device, feed-forward, with int8 synthetic gradients.

from pathlib import Path
from qsgm import finetune, load_bundle, load_object, read_frame

result = finetune(read_frame(Path("object.png")), load_bundle(Path("export")))
result.save(Path("mug"), name="mug")
detection, heatmap = load_object(Path("mug")).locate(read_frame(Path("scene.png")))
"""

import importlib
import os
from typing import TYPE_CHECKING

from qsgm.errors import QsgmError

# From 1.29 on ONNX Runtime, by itself and from the moment it is imported, writes a device id and an
# event database under the user's cache and looks up a collector for them; a forked child that ends
# normally then never ends. disable_telemetry_events() comes too late. This comes in time, because
# Python imports a package before any of its modules; whoever imports ONNX Runtime before qsgm has
# to set it. A setting of the user's own stays.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

if TYPE_CHECKING:
    from qsgm.bundle import load_bundle
    from qsgm.grasp.source import Demonstration
    from qsgm.grasp.tuned import load_object
    from qsgm.images import read_frame
    from qsgm.tune.run import finetune
    from qsgm.tune.settings import Settings
else:
    # Imported when asked for, since they bring in ONNX Runtime and OpenCV. None of these modules
    # may have the name of an export: importing it would put the module in the export's place.
    _HOME = {
        "Demonstration": "qsgm.grasp.source",
        "Settings": "qsgm.tune.settings",
        "finetune": "qsgm.tune.run",
        "load_bundle": "qsgm.bundle",
        "load_object": "qsgm.grasp.tuned",
        "read_frame": "qsgm.images",
    }

    def __getattr__(name: str) -> object:
        if name not in _HOME:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(importlib.import_module(_HOME[name]), name)


__version__ = "0.1.0"
__all__ = [
    "Demonstration",
    "QsgmError",
    "Settings",
    "__version__",
    "finetune",
    "load_bundle",
    "load_object",
    "read_frame",
]
