"""Move a fit until the object's outline lies on edges of the scene.

A thing of one colour says by its pixels neither where it is nor how far turned: it looks the same a
few pixels on. Its outline does. Along the normal of every outline point the strongest edge with the
object's colour on its inner side is looked for, and the pose that brings the points there is solved
for by iteratively reweighted least squares (after RAPID, Harris and Stennett 1990).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.alignment import as_taught, stepped
from qsgm.grasp.cells import SIDE, Cells
from qsgm.grasp.correlation import Fit, Pyramid
from qsgm.grasp.outline import Outline, sampled

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

_LOOKS, _REWEIGHTINGS = 4, 3
# How far an edge is looked for [px of the level], and how far off edges mostly are.
_REACH_PX, _USUAL_PX = 5, 4.0
_OFFSETS = np.arange(-_REACH_PX, _REACH_PX + 1, dtype=np.float32)
_USUAL = np.exp(-((_OFFSETS[1:-1] / _USUAL_PX) ** 2) / 2)
# A colour on the inner side that is off by so many levels halves what an edge counts.
_OTHER_COLOUR = np.float32(40.0)
# No edge counts more than what so many of the edges do not reach.
_STRONG = 0.8
# From so many px on, what a point says is off rather than informative.
_OUTLIER_PX = 1.0
# What a fit may be off by: right and down [px of the level], turn [rad], log of the scale.
_PRIOR = np.diag(1 / np.array([4.0, 4.0, 0.15, 0.1]) ** 2)
_NOTHING = np.array([0.1, 0.1, 0.003, 0.003])


@dataclass(frozen=True)
class Snapper:
    """An outline of N points, ready to be laid over edges."""

    lines: tuple[Floats, Floats]  # x and y, each (N, M), across the outline at M offsets
    colours: Floats  # (3, N, 1), taught just inside
    moves: Doubles  # (N, 4): how far outwards each point goes by each kind of step

    @staticmethod
    def of(cells: Cells) -> "Snapper":
        """What a demonstration's outline is looked for by."""
        outline = Outline.of(cells.solid)
        across, below = -outline.inward.astype(np.float64).T
        right, down = (outline.points.astype(np.float64) - (SIDE - 1) / 2).T
        turn, growth = across * down - below * right, across * right + below * down
        moves = np.stack([across, below, turn, growth], axis=1)
        colours = np.ascontiguousarray(outline.colours_inside(cells.image).T)[..., None]
        return Snapper(outline.lines(_OFFSETS), colours, moves)

    def snapped(self, scene: Pyramid, fit: Fit) -> Fit:
        """The fit moved, turned and scaled to where the object's outline finds its edges.

        Args:
            scene: the frame.
            fit: off by few pixels.

        Returns:
            The moved fit, with the score of the given one.
        """
        here = fit
        for _ in range(_LOOKS):
            step = self._solved(*self._edges(as_taught(scene, here)))
            here = stepped(here, step)
            if (np.abs(step) < _NOTHING).all():
                break
        return here

    def _edges(self, seen: Floats) -> tuple[Floats, Floats]:
        """How far (N,) [px] outwards of each point its edge is, and what that counts (N,)."""
        colours = np.ascontiguousarray(sampled(seen, *self.lines).transpose(2, 0, 1))
        inner, outer = colours[..., :-2], colours[..., 2:]
        count = _lengths(outer - inner)
        count /= 1 + _lengths(inner - self.colours) / _OTHER_COLOUR
        count *= _USUAL
        best = count.argmax(axis=1)
        weight = count[np.arange(len(best)), best]
        weight = np.minimum(weight, np.sort(weight)[int(_STRONG * len(weight))])
        return _OFFSETS[1:-1][best], np.asarray(weight / (weight.mean() + 1e-6), dtype=np.float32)

    def _solved(self, off: Floats, weight: Floats) -> Doubles:
        """By how much (4,) the patch is off, as :func:`qsgm.grasp.alignment.stepped` takes it."""
        moves = self.moves
        step = np.zeros(4)
        for _ in range(_REWEIGHTINGS):
            left = moves @ step + off
            weighed = moves.T * (weight / (1 + (left / _OUTLIER_PX) ** 2))
            found = np.linalg.solve(weighed @ moves + _PRIOR, -weighed @ off)
            step = np.asarray(found, np.float64)
        return step


def _lengths(apart: Floats) -> Floats:
    """Lengths (N, M) of differences of colours (3, N, M)."""
    return np.asarray(np.sqrt(np.einsum("cnm,cnm->nm", apart, apart)))
