"""Fine-tune a network on the device, feed-forward, with int8 synthetic gradients.

from pathlib import Path
from qsgm import finetune, load_bundle, load_object, read_frame

result = finetune(read_frame(Path("object.png")), load_bundle(Path("export")))
result.save(Path("mug"), name="mug")
detection, heatmap = load_object(Path("mug")).locate(read_frame(Path("scene.png")))
"""

from qsgm.bundle import load_bundle
from qsgm.errors import QsgmError
from qsgm.finetune import Settings, finetune
from qsgm.images import read_frame
from qsgm.tuned import load_object

__version__ = "0.1.0"
__all__ = [
    "QsgmError",
    "Settings",
    "__version__",
    "finetune",
    "load_bundle",
    "load_object",
    "read_frame",
]
