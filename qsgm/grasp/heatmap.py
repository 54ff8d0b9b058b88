"""From a heatmap to one grasp: where the object is, how far to move, how far to turn.

This is the network's own answer. Where a tuned object has a patch of its demonstration, that has
the last word (:mod:`qsgm.grasp.finding`).

A heatmap has one cell per 128x128 window of the frame, 16 px apart. The network was taught to
answer "yes" within 4 px of the object's centre and "no" from 28 px on, so an object makes a blob
one to three cells wide. The centre is the quality-weighted mean of the 3x3 cells around the
peak: for a symmetrical response these reach past the blob's edge on every side, wherever between
two cells the centre lies, so cutting off the rest moves the mean by a pixel or two at most.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from qsgm.errors import QsgmError
from qsgm.grasp.angles import AngleEncoding, decode_angle, wrap_half_turn
from qsgm.grasp.crops import HALF_CROP_PX, POSITIVE_JITTER_PX
from qsgm.grasp.network import CROP_PX

CELL_PX = 16
# The second look: windows this far apart, with centres up to this far from the first estimate.
FINE_PX = 4
FINE_REACH_PX = 32
FINE_SIDE_PX = CROP_PX + 2 * FINE_REACH_PX
# Cells this close to the best one are as good; the best supported of them is the blob's middle.
_AS_GOOD = 0.9
_EPSILON = 1e-9


RefinedBy = Literal["patch", "network"]


@dataclass(frozen=True)
class Detection:
    """The one object in a frame. When not `found`, the other fields describe the best guess."""

    found: bool
    quality: float  # in [0, 1]
    center_px: tuple[float, float]  # (x, y) in the frame
    displacement_px: tuple[float, float]  # (x, y) from the frame's centre; right and down positive
    angle_deg: float  # turn since the demonstration, in (-90, 90], counter-clockwise positive
    full_angle_deg: float | None = None  # the same in (-180, 180], where it is known
    full_angle_confidence: float | None = None  # that it is not the opposite, in [0, 1]
    refined_by: RefinedBy = "network"  # whence centre and angle are
    scale: float = 1.0  # what the frame was scaled by for the network
    margin_px: int = 0  # and mirrored beyond its border after that
    # Where else it may be, best first; this one is the first. They have none of their own.
    candidates: tuple["Detection", ...] = ()


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


def refine(
    coarse: Detection,
    frame: NDArray[np.uint8],  # (H, W, 3)
    heatmap_of: Callable[[NDArray[np.uint8]], NDArray[np.float32]],
    offset_rad: float,
    encoding: AngleEncoding = "double",
) -> Detection:
    """Look again around a detection, with windows 4 px apart instead of 16.

    On the coarse grid the nearest window is up to 11 px off the object's centre, more than the
    network was taught to answer for. Sixteen small heatmaps, each shifted, make up the fine grid:
    its centroid is the centre, and the angle comes from the windows right there.

    Args:
        coarse: from :func:`locate`.
        frame: the whole frame.
        heatmap_of: the tuned network, on a part of the frame.
        offset_rad: the demonstration's own orientation as the network sees it.
        encoding: what sine and cosine stand for.
    """
    fine, x, y = _fine_grid(coarse, frame, heatmap_of)
    quality = fine[0].astype(np.float64)
    weight = np.maximum(quality - quality.max() / 2, 0.0) + _EPSILON
    weight /= weight.sum()
    center = float((weight * x).sum()), float((weight * y).sum())
    near = np.exp(-0.5 * ((x - center[0]) ** 2 + (y - center[1]) ** 2) / POSITIVE_JITTER_PX**2)
    sine, cosine = (near * fine[1]).sum(), (near * fine[2]).sum()
    angle = decode_angle(sine, cosine, encoding)
    height, width = frame.shape[:2]
    return replace(
        coarse,
        center_px=center,
        displacement_px=(center[0] - width / 2, center[1] - height / 2),
        angle_deg=float(np.degrees(wrap_half_turn(angle - offset_rad))),
    )


def _fine_grid(
    coarse: Detection,
    frame: NDArray[np.uint8],
    heatmap_of: Callable[[NDArray[np.uint8]], NDArray[np.float32]],
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]]:
    """Answers (3, n) of windows 4 px apart around a detection, and their centres x, y (n,)."""
    shifts = range(0, CELL_PX, FINE_PX)
    corner = [
        max(min(round(center) - FINE_REACH_PX - HALF_CROP_PX, size - FINE_SIDE_PX), 0)
        for center, size in zip(coarse.center_px, frame.shape[1::-1], strict=True)
    ]
    answers, xs, ys = [], [], []
    for down, right in product(shifts, shifts):
        left, top = corner[0] + right, corner[1] + down
        part = frame[top : top + FINE_SIDE_PX - CELL_PX, left : left + FINE_SIDE_PX - CELL_PX]
        if min(part.shape[:2]) < CROP_PX:  # a frame hardly larger than a window
            continue
        heatmap = heatmap_of(np.ascontiguousarray(part))
        rows, cols = np.mgrid[: heatmap.shape[1], : heatmap.shape[2]]
        answers.append(heatmap.reshape(3, -1))
        xs.append((left + HALF_CROP_PX + CELL_PX * cols).ravel())
        ys.append((top + HALF_CROP_PX + CELL_PX * rows).ravel())
    return (
        np.concatenate(answers, axis=1),
        np.concatenate(xs).astype(np.float64),
        np.concatenate(ys).astype(np.float64),
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
