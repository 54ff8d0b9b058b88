"""What speaks for and against a candidate being the taught object, beside how the two look.

A :class:`qsgm.grasp.decision.Decision` weighs these few numbers and what the comparer says of both
pictures. More of them, of colours, contrast and edges, gained nothing on drawn scenes once the
comparer had learnt enough, and cost a tenth of the answers in photographs (`docs/design.md`).
"""

import numpy as np
from numpy.typing import NDArray

NAMES = (
    "correlation",  # of the cells that agree, as one image
    "scale",  # |log|
    "quality_logit",  # what the tuned network says
    "lead",  # over the other way round
)
_LARGEST_LOGIT = 8.0


def evidence(correlation: float, scale: float, quality: float, lead: float) -> NDArray[np.float32]:
    """One number for each of :data:`NAMES`.

    Args:
        correlation: of the cells that agree.
        scale: of the fit.
        quality: of the network, in [0, 1].
        lead: the fit's score over that of the other way round.
    """
    odds = np.log(max(quality, 1e-6) / max(1 - quality, 1e-6))
    logit = np.clip(odds, -_LARGEST_LOGIT, _LARGEST_LOGIT)
    return np.array([correlation, abs(np.log(scale)), logit, lead], np.float32)
