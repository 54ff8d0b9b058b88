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
# OpenCV reads this when it is loaded. Four times the largest frame, since the process is not only
# qsgm's: headers are checked before, and this is for what a decoder sees in a file and they do not.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**26))

if TYPE_CHECKING:
    from qsgm.bundle import Bundle, load_bundle
    from qsgm.fidelity import LayerFidelity
    from qsgm.grasp.heatmap import Detection
    from qsgm.grasp.others import Other, other_in
    from qsgm.grasp.source import Demonstration
    from qsgm.grasp.taught import FinetuneResult
    from qsgm.grasp.teach import finetune
    from qsgm.grasp.tuned import TunedObject, load_object
    from qsgm.grasp.verdict import Verdict
    from qsgm.grasp.watch import Watched, watch
    from qsgm.images import read_frame
    from qsgm.network import Layer, Network, conv
    from qsgm.samples.lesson import Samples
    from qsgm.samples.task import RecordedTask, SampleTask
    from qsgm.samples.taskfile import load_task
    from qsgm.samples.teach import learn
    from qsgm.samples.tuned import TunedNetwork, load_network
    from qsgm.task import Head, Labelled, Lesson, Task
    from qsgm.tune.plan import Plan, resolve
    from qsgm.tune.prepare import Prepared, prepare
    from qsgm.tune.probe import Probe
    from qsgm.tune.result import Result
    from qsgm.tune.settings import Settings
else:
    # Imported when asked for, since they bring in ONNX Runtime and OpenCV.
    _NAMES = {
        "qsgm.bundle": "Bundle load_bundle",
        "qsgm.fidelity": "LayerFidelity",
        "qsgm.grasp.heatmap": "Detection",
        "qsgm.grasp.others": "Other other_in",
        "qsgm.grasp.source": "Demonstration",
        "qsgm.grasp.taught": "FinetuneResult",
        "qsgm.grasp.teach": "finetune",
        "qsgm.grasp.tuned": "TunedObject load_object",
        "qsgm.grasp.verdict": "Verdict",
        "qsgm.grasp.watch": "Watched watch",
        "qsgm.images": "read_frame",
        "qsgm.network": "Layer Network conv",
        "qsgm.samples.lesson": "Samples",
        "qsgm.samples.task": "RecordedTask SampleTask",
        "qsgm.samples.taskfile": "load_task",
        "qsgm.samples.teach": "learn",
        "qsgm.samples.tuned": "TunedNetwork load_network",
        "qsgm.task": "Head Labelled Lesson Task",
        "qsgm.tune.plan": "Plan resolve",
        "qsgm.tune.prepare": "Prepared prepare",
        "qsgm.tune.probe": "Probe",
        "qsgm.tune.result": "Result",
        "qsgm.tune.settings": "Settings",
    }
    _HOME = {name: home for home, names in _NAMES.items() for name in names.split()}

    def __getattr__(name: str) -> object:
        if name not in _HOME:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(importlib.import_module(_HOME[name]), name)


__version__ = "0.1.0"
__all__ = [
    "Bundle",
    "Demonstration",
    "Detection",
    "FinetuneResult",
    "Head",
    "Labelled",
    "Layer",
    "LayerFidelity",
    "Lesson",
    "Network",
    "Other",
    "Plan",
    "Prepared",
    "Probe",
    "QsgmError",
    "RecordedTask",
    "Result",
    "SampleTask",
    "Samples",
    "Settings",
    "Task",
    "TunedNetwork",
    "TunedObject",
    "Verdict",
    "Watched",
    "__version__",
    "conv",
    "finetune",
    "learn",
    "load_bundle",
    "load_network",
    "load_object",
    "load_task",
    "other_in",
    "prepare",
    "read_frame",
    "resolve",
    "watch",
]
