"""From a heatmap to one grasp: where the object is, how far to move, how far to turn.

A heatmap has one cell per 128x128 window of the frame, 16 px apart. The network was taught to
answer "yes" within 4 px of the object's centre and "no" from 28 px on, so an object makes a blob
one to three cells wide. The centre is the quality-weighted mean of the 3x3 cells around the
peak: for a symmetrical response these reach past the blob's edge on every side, wherever between
two cells the centre lies, so cutting off the rest moves the mean by a pixel or two at most.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from qsgm.angles import AngleEncoding, decode_angle, wrap_half_turn
from qsgm.crops import HALF_CROP_PX
from qsgm.errors import QsgmError

CELL_PX = 16
# Cells this close to the best one are as good; the best supported of them is the blob's middle.
_AS_GOOD = 0.9
_EPSILON = 1e-9


@dataclass(frozen=True)
class Detection:
    """The one object in a frame. When not `found`, the other fields describe the best guess."""

    found: bool
    quality: float  # in [0, 1]
    center_px: tuple[float, float]  # (x, y) in the frame
    displacement_px: tuple[float, float]  # (x, y) from the frame's centre; right and down positive
    angle_deg: float  # turn since the demonstration, in (-90, 90], counter-clockwise positive


def locate(
    heatmap: NDArray[np.float32],
    frame_hw: tuple[int, int],
    offset_rad: float,
    encoding: AngleEncoding = "double",
    threshold: float = 0.5,
) -> Detection:
    """Find the object in a heatmap.

    Args:
        heatmap: (3, rows, cols): quality in [0, 1], sine and cosine of the angle.
        frame_hw: height and width of the frame [px].
        offset_rad: the demonstration's own orientation as the network sees it.
        encoding: what sine and cosine stand for.
        threshold: quality from which the object counts as found.

    Raises:
        QsgmError: the heatmap is not finite: the tuned object cannot be used.
    """
    if heatmap.ndim != 3 or heatmap.shape[0] != 3 or 0 in heatmap.shape:
        raise ValueError(f"`heatmap` must be (3, rows, cols), got {heatmap.shape}")
    if not np.isfinite(heatmap).all():
        raise QsgmError("the tuned object answers with NaN or infinity; tune it again")
    row, col = _peak(heatmap[0])
    # Up to 3x3 cells; at the heatmap's border those outside are missing.
    rows = np.arange(max(row - 1, 0), min(row + 2, heatmap.shape[1]))[:, None]
    cols = np.arange(max(col - 1, 0), min(col + 2, heatmap.shape[2]))
    quality, sine, cosine = heatmap[:, rows, cols].astype(np.float64)
    weight = (quality + _EPSILON) / (quality + _EPSILON).sum()
    x, y = _cell_center(float((weight * cols).sum()), float((weight * rows).sum()))
    angle = decode_angle((weight * sine).sum(), (weight * cosine).sum(), encoding)
    best = float(quality.max())
    return Detection(
        found=best >= threshold,
        quality=best,
        center_px=(x, y),
        displacement_px=(x - frame_hw[1] / 2, y - frame_hw[0] / 2),
        angle_deg=float(np.degrees(wrap_half_turn(angle - offset_rad))),
    )


def _peak(quality: NDArray[np.float32]) -> tuple[int, int]:
    """Row and column of the middle of the strongest blob in (rows, cols).

    The plain maximum would do, were a saturated blob not a plateau whose largest cell is chance.
    """
    padded = np.pad(quality.astype(np.float64), 1, mode="edge")
    across = padded[:, :-2] + 2 * padded[:, 1:-1] + padded[:, 2:]
    support = across[:-2] + 2 * across[1:-1] + across[2:]
    support[quality < _AS_GOOD * quality.max()] = -1.0
    row, col = divmod(int(support.argmax()), quality.shape[1])
    return row, col


def _cell_center(col: float, row: float) -> tuple[float, float]:
    """Centre (x, y) [px] of the window that a cell looks at; fractions lie between cells."""
    return HALF_CROP_PX + CELL_PX * col, HALF_CROP_PX + CELL_PX * row
