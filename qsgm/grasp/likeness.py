"""What a patch is worth as a second opinion: whether it was cut out, has markings, has a front."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.correlation import COARSE, NOISE_VARIANCE, correlate, pyramid_of, windows_around
from qsgm.grasp.finding import LEAST_CONFIDENCE, confidence_of
from qsgm.grasp.judge import Appearance, best_fit
from qsgm.grasp.patch import PATCH_PX, Patch

# A patch that varies no more than this is as much like noise as like itself.
_FEATURELESS_VARIANCE = 3 * NOISE_VARIANCE
# A patch that is that much like itself at every turn is round.
_ROUND_CORRELATION = 0.9
# A plain one is round if its smallest rectangle is that much of a square.
_ROUND_SHARE = 0.85
_RIM_PX = 9  # within half of that from its outline an object may show some table
_INNER_SHARE = 0.2
_TURNS = tuple((float(turn), 1.0) for turn in np.deg2rad(np.arange(0, 360, 15)))
_MIDDLE_PX = (PATCH_PX - 1) / 2


@dataclass(frozen=True)
class Likeness:
    """Likeness of a demonstration's patch to what it could be taken for."""

    cut_out: bool  # whether its pixels could be told from the table
    featureless: bool
    round: bool  # the same at every turn
    same_both_ways: bool  # the same when it is turned by half a turn


def likeness_of(patch: Patch) -> Likeness:
    """Compare a patch with itself."""
    appearance = Appearance.of(patch)
    _, lead = best_fit(appearance, patch.image, (_MIDDLE_PX, _MIDDLE_PX))
    by_turn = likeness_by_turn(appearance, patch.image)
    long_px, short_px = patch.span_px
    featureless = inner_variance(patch) < _FEATURELESS_VARIANCE
    same_outline = featureless and short_px > _ROUND_SHARE * long_px
    return Likeness(
        patch.cut_out,
        featureless,
        same_outline or bool(by_turn.min() > _ROUND_CORRELATION),
        confidence_of(lead) < LEAST_CONFIDENCE,
    )


def inner_variance(patch: Patch) -> float:
    """Variance of an object's pixels, all channels together, without its rim if enough is left."""
    inner = cv2.erode(patch.mask, np.ones((_RIM_PX, _RIM_PX), np.uint8)) > 0
    solid = patch.mask > 0
    enough = inner.sum() > _INNER_SHARE * solid.sum()
    return float(patch.image[inner if enough else solid].astype(np.float64).var(axis=0).sum())


def likeness_by_turn(appearance: Appearance, image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Correlation of a patch (160, 160, 3) with itself, turned in steps of 15 degrees: (24,)."""
    trials = appearance.template.trials(COARSE, _TURNS)
    middle = _MIDDLE_PX, _MIDDLE_PX
    windows, _ = windows_around(pyramid_of(image), COARSE, middle, 1, trials.live)
    return np.asarray(correlate(windows, trials).max(axis=0))
