"""Fine-tune a network on the device, feed-forward, with int8 synthetic gradients."""

from qsgm.errors import QsgmError

__version__ = "0.1.0"
__all__ = ["QsgmError", "__version__"]
