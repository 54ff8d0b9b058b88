"""Move a fit until the object's outline lies on edges of the scene.

A thing of one colour says by its pixels neither where it is nor how far turned: it looks the same a
few pixels on. Its outline does. Along the normal of every outline point the strongest edge with the
object's colour on its inner side is looked for, and the pose that brings the points there is solved
for by iteratively reweighted least squares (after RAPID, Harris and Stennett 1990).
"""

import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.alignment import as_taught, stepped
from qsgm.grasp.cells import SIDE
from qsgm.grasp.correlation import Fit, Pyramid
from qsgm.grasp.evidence import Reference

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

_LOOKS, _REWEIGHTINGS = 4, 3
# How far an edge is looked for [px of the level], and how far off edges mostly are.
_REACH_PX, _USUAL_PX = 5, 4.0
_OFFSETS = np.arange(-_REACH_PX, _REACH_PX + 1, dtype=np.float32)
# A colour on the inner side that is off by so many levels halves what an edge counts.
_OTHER_COLOUR = 40.0
# No edge counts more than what so many of the edges do not reach.
_STRONG = 0.8
# From so many px on, what a point says is off rather than informative.
_OUTLIER_PX = 1.0
# What a fit may be off by: right and down [px of the level], turn [rad], log of the scale.
_EXPECTED_ERROR = np.array([4.0, 4.0, 0.15, 0.1])
_NOTHING = np.array([0.1, 0.1, 0.003, 0.003])


def snapped(reference: Reference, scene: Pyramid, fit: Fit) -> Fit:
    """The fit moved, turned and scaled to where the object's outline finds its edges.

    Args:
        reference: the demonstration.
        scene: the frame.
        fit: off by few pixels.

    Returns:
        The moved fit, with the score of the given one.
    """
    here = fit
    for _ in range(_LOOKS):
        off, weight = _edges(reference, as_taught(scene, here))
        step = _solved(reference, off, weight)
        here = stepped(here, step)
        if (np.abs(step) < _NOTHING).all():
            break
    return here


def _edges(reference: Reference, seen: Floats) -> tuple[Floats, Floats]:
    """How far (N,) [px] outwards of each outline point its edge is, and what that counts (N,)."""
    colours = reference.outline.across(seen, _OFFSETS)
    strength = np.linalg.norm(colours[:, 2:] - colours[:, :-2], axis=2)
    other = np.linalg.norm(colours[:, :-2] - reference.rim_colours[:, None], axis=2)
    offsets = _OFFSETS[1:-1]
    usual = np.exp(-((offsets / _USUAL_PX) ** 2) / 2)
    count = strength / (1 + other / _OTHER_COLOUR) * usual
    best = count.argmax(axis=1)
    weight = count[np.arange(len(best)), best]
    weight = np.minimum(weight, np.sort(weight)[int(_STRONG * len(weight))])
    return offsets[best], np.asarray(weight / (weight.mean() + 1e-6), dtype=np.float32)


def _solved(reference: Reference, off: Floats, weight: Floats) -> Doubles:
    """By how much (4,) the patch is off, as :func:`qsgm.grasp.alignment.stepped` takes it."""
    outward = -reference.outline.inward.astype(np.float64)
    right, down = (reference.outline.points.astype(np.float64) - (SIDE - 1) / 2).T
    across, below = outward.T
    moves = np.stack(
        [across, below, across * down - below * right, across * right + below * down], axis=1
    )
    prior, step = np.diag(1 / _EXPECTED_ERROR**2), np.zeros(4)
    for _ in range(_REWEIGHTINGS):
        left = moves @ step + off
        count = weight / (1 + (left / _OUTLIER_PX) ** 2)
        weighed = moves * count[:, None]
        step = np.linalg.solve(weighed.T @ moves + prior, -weighed.T @ off)
    return step
