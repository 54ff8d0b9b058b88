"""What a patch is worth as a second opinion: whether it was cut out, has markings, has a front."""

from dataclasses import dataclass

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
_TURNS = tuple((float(turn), 1.0) for turn in np.deg2rad(np.arange(0, 360, 15)))
_MIDDLE_PX = (PATCH_PX - 1) / 2


@dataclass(frozen=True)
class Likeness:
    """Of a demonstration's patch, to what it could be taken for."""

    cut_out: bool  # whether its pixels could be told from the table
    featureless: bool
    round: bool  # the same at every turn
    same_both_ways: bool  # the same when it is turned by half a turn


def likeness_of(patch: Patch) -> Likeness:
    """Compare a patch with itself."""
    appearance = Appearance.of(patch)
    _, lead = best_fit(appearance, patch.image, (_MIDDLE_PX, _MIDDLE_PX))
    by_turn = likeness_by_turn(appearance, patch.image)
    return Likeness(
        patch.cut_out,
        float(appearance.aligner.variance) < _FEATURELESS_VARIANCE,
        bool(by_turn.min() > _ROUND_CORRELATION),
        confidence_of(lead) < LEAST_CONFIDENCE,
    )


def likeness_by_turn(appearance: Appearance, image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Correlation of a patch (160, 160, 3) with itself, turned in steps of 15 degrees: (24,)."""
    trials = appearance.template.trials(COARSE, _TURNS)
    windows, _ = windows_around(pyramid_of(image), COARSE, (_MIDDLE_PX, _MIDDLE_PX), 1)
    scores, _, _ = correlate(windows, trials)
    return np.asarray(scores.max(axis=0))
