"""The host side: drawing, pretraining, folding, quantizing, exporting. Needs the extra `train`."""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from qsgm.train.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
    from qsgm.train.export import ExportOptions, export_bundle
    from qsgm.train.export_report import ExportReport
    from qsgm.train.model.from_torch import from_torch
    from qsgm.train.pretraining.pretrain import PretrainConfig, pretrain
    from qsgm.train.quantization.lessons import Lessons
    from qsgm.train.samples.build import build
    from qsgm.train.samples.drawn import quicker, usual_config
    from qsgm.train.slim import SlimReport, slim_bundle
    from qsgm.train.task import DrawnTask
else:
    # Imported when asked for, since most bring in torch.
    _NAMES = {
        "qsgm.train.checkpoint": "Checkpoint load_checkpoint save_checkpoint",
        "qsgm.train.export": "ExportOptions export_bundle",
        "qsgm.train.export_report": "ExportReport",
        "qsgm.train.model.from_torch": "from_torch",
        "qsgm.train.pretraining.pretrain": "PretrainConfig pretrain",
        "qsgm.train.quantization.lessons": "Lessons",
        "qsgm.train.samples.build": "build",
        "qsgm.train.samples.drawn": "quicker usual_config",
        "qsgm.train.slim": "SlimReport slim_bundle",
        "qsgm.train.task": "DrawnTask",
    }
    _HOME = {name: home for home, names in _NAMES.items() for name in names.split()}

    def __getattr__(name: str) -> object:
        if name not in _HOME:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(importlib.import_module(_HOME[name]), name)


__all__ = [
    "Checkpoint",
    "DrawnTask",
    "ExportOptions",
    "ExportReport",
    "Lessons",
    "PretrainConfig",
    "SlimReport",
    "build",
    "export_bundle",
    "from_torch",
    "load_checkpoint",
    "pretrain",
    "quicker",
    "save_checkpoint",
    "slim_bundle",
    "usual_config",
]
