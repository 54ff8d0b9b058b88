"""Lay the demonstration's patch over a scene: where, how far turned and how large it fits best.

Masked, normalised colour correlation: of the patch only the object's pixels count, each channel
around its own mean, so that neither the table nor the light matters. Coarse to fine: at an eighth
of the resolution every turn and a few scales are tried at every place within 16 px of a candidate;
the best few go on to a quarter of it. All trials of one level are three matrix products.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import cos, radians, sin

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from qsgm.grasp.patch import PATCH_PX, Patch, mirrored_square

Floats = NDArray[np.float32]

WINDOW_PX = 128
# Halvings of the resolution, coarse to fine.
COARSE, MIDDLE, FINE = 3, 2, 1
_STRIP_ROWS = 64  # halved at once
SCALES = (0.85, 1.0, 1.18)
# Variance [levels²] that a flat surface's noise has anyway: without it noise correlates with noise.
NOISE_VARIANCE = 30.0

_COARSE_POSES = tuple(
    (float(turn), scale) for scale in SCALES for turn in np.deg2rad(np.arange(0, 360, 10))
)
_COARSE_REACH = 2  # px of the level
_MIDDLE_TURNS = (-radians(5), 0.0, radians(5))
_MIDDLE_SCALES, _MIDDLE_REACH = (0.93, 1.0, 1.07), 2
# Turns that differ by less are the same hypothesis.
_SAME_TURN = np.deg2rad(25)
_STARTS = 3


@dataclass(frozen=True)
class Fit:
    """One way in which the patch lies over a scene."""

    score: float  # correlation, at most 1
    turn_rad: float  # since the demonstration, counter-clockwise
    scale: float
    center_px: tuple[float, float]  # (x, y)


@dataclass(frozen=True)
class Pyramid:
    """A frame at falling resolution, halved once, twice and three times."""

    halved: tuple[Floats, ...]  # (h, w, 3)

    def level(self, halvings: int) -> Floats:
        """The frame halved so many times, at least once."""
        return self.halved[halvings - 1]


def pyramid_of(frame: NDArray[np.uint8]) -> Pyramid:
    """Halve a frame (H, W, 3) again and again: each pixel is the mean of four."""
    levels = [_halved(frame)]
    while len(levels) < COARSE:
        levels.append(_halved(levels[-1]))
    return Pyramid(tuple(levels))


def _halved(image: NDArray[np.uint8] | Floats) -> Floats:
    """Half of an image, strip by strip: the whole of it as floats is four times as large."""
    height, width = (max(side // 2, 1) for side in image.shape[:2])
    even = image[: 2 * height, : 2 * width]  # else a pixel would be of a little more
    halved = np.empty((height, width, 3), np.float32)
    for top in range(0, height, _STRIP_ROWS):
        strip = halved[top : top + _STRIP_ROWS]
        rows = even[2 * top : 2 * (top + len(strip))].astype(np.float32)
        cv2.resize(rows, (width, len(strip)), strip, interpolation=cv2.INTER_AREA)
    return halved


@dataclass(frozen=True)
class Trials:
    """K turned and scaled patches at one level, as rows of matrices."""

    centred: Floats  # (K, 3 D): pixel minus mean, times the mask
    mask: Floats  # (K, D), sums to 1
    variance: Floats  # (K,)
    mean: Floats  # (K, 3)


@dataclass(frozen=True)
class Template:
    """A patch, ready to be laid over scenes; what all of them need of it is kept."""

    patch: Patch
    _coarse: list[Trials] = field(default_factory=list)
    _layers: dict[int, Floats] = field(default_factory=dict)

    def trials(self, level: int, poses: Sequence[tuple[float, float]]) -> Trials:
        """The patch in every pose (turn [rad], scale), side by side."""
        return _trials_of(self.layer(level), level, poses)

    def coarse_trials(self) -> Trials:
        """The patch in all coarse poses."""
        if not self._coarse:
            self._coarse.append(self.trials(COARSE, _COARSE_POSES))
        return self._coarse[0]

    def layer(self, level: int) -> Floats:
        """Image and mask, (side, side, 4), at a level."""
        if level not in self._layers:
            both = np.dstack([self.patch.image, self.patch.mask]).astype(np.float32)
            side = PATCH_PX >> level
            small = cv2.resize(both, (side, side), interpolation=cv2.INTER_AREA)
            self._layers[level] = np.asarray(small, dtype=np.float32)
        return self._layers[level]


def coarse_fits(
    template: Template, scene: Pyramid, centers_px: Sequence[tuple[float, float]]
) -> list[list[Fit]]:
    """The best ways to lay the patch near each of some points, at an eighth of the resolution.

    Args:
        template: the demonstration's.
        scene: its frame.
        centers_px: where to look, each within 16 px.

    Returns:
        Up to three for each point, best first, their turns at least 25 degrees apart.
    """
    trials = template.coarse_trials()
    around = [windows_around(scene, COARSE, center, _COARSE_REACH) for center in centers_px]
    scores, _, _ = correlate(np.concatenate([windows for windows, _ in around]), trials)
    of_each = scores.reshape(len(around), -1, len(_COARSE_POSES))
    return [
        _distinct(some, places, _COARSE_POSES)
        for some, (_, places) in zip(of_each, around, strict=True)
    ]


def middle_fit(template: Template, scene: Pyramid, start: Fit) -> Fit:
    """A coarse fit at a quarter of the resolution."""
    return _refined(template, scene, MIDDLE, start, _MIDDLE_TURNS, _MIDDLE_SCALES, _MIDDLE_REACH)


def _refined(
    template: Template,
    scene: Pyramid,
    level: int,
    start: Fit,
    turns: Sequence[float],
    scales: Sequence[float],
    reach: int,
) -> Fit:
    poses = [(start.turn_rad + turn, start.scale * scale) for scale in scales for turn in turns]
    scores, places = _scores(template, scene, level, poses, start.center_px, reach)
    place, pose = np.unravel_index(int(scores.argmax()), scores.shape)
    x, y = places[place]
    return Fit(float(scores[place, pose]), *poses[pose], (float(x), float(y)))


def _distinct(scores: Floats, places: Floats, poses: Sequence[tuple[float, float]]) -> list[Fit]:
    """The best trials whose turns differ, as starts for the next level."""
    best = scores.max(axis=0)
    starts: list[Fit] = []
    for pose in np.argsort(-best, kind="stable"):
        turn, scale = poses[pose]
        if all(abs(_wrapped(turn - start.turn_rad)) > _SAME_TURN for start in starts):
            place = places[int(scores[:, pose].argmax())]
            starts.append(Fit(float(best[pose]), turn, scale, (float(place[0]), float(place[1]))))
        if len(starts) == _STARTS:
            break
    return starts


def _scores(
    template: Template,
    scene: Pyramid,
    level: int,
    poses: Sequence[tuple[float, float]],
    center_px: tuple[float, float],
    reach: int,
) -> tuple[Floats, Floats]:
    """Correlation (A, K) of K poses at A places, and the places (A, 2) [px of the frame]."""
    trials = template.trials(level, poses)
    windows, places = windows_around(scene, level, center_px, reach)
    score, _, _ = correlate(windows, trials)
    return score, places


def correlate(windows: Floats, trials: Trials) -> tuple[Floats, Floats, Floats]:
    """Masked colour correlation of windows (A, 3, D) with K trials.

    Returns:
        Correlation (A, K); the windows' means under each mask (A, 3, K) and variances (A, K).
    """
    count, channels, pixels = windows.shape
    mean = (windows.reshape(-1, pixels) @ trials.mask.T).reshape(count, channels, -1)
    square = np.einsum("acd,acd->ad", windows, windows) @ trials.mask.T
    variance = np.maximum(square - np.einsum("ack,ack->ak", mean, mean), 0.0)
    product = windows.reshape(count, -1) @ trials.centred.T
    size = (variance + NOISE_VARIANCE) * (trials.variance + NOISE_VARIANCE)
    return product / np.sqrt(size), mean, variance


def windows_around(
    scene: Pyramid, level: int, center_px: tuple[float, float], reach: int
) -> tuple[Floats, Floats]:
    """All windows (A, 3, D) of a level within `reach` pixels of a point, and their centres (A, 2).

    A centre is in pixels of the frame; beyond the border the frame is mirrored.
    """
    side, step = WINDOW_PX >> level, 1 << level
    image = scene.level(level)
    left, top = (round((value + 0.5) / step - side / 2) - reach for value in center_px)
    region = mirrored_square(image, left, top, side + 2 * reach)
    channels = np.ascontiguousarray(region.transpose(2, 0, 1))
    views = sliding_window_view(channels, (side, side), (1, 2))  # (3, rows, columns, side, side)
    windows = views.transpose(1, 2, 0, 3, 4).reshape(-1, 3, side * side)
    at = np.arange(2 * reach + 1)
    places = np.empty((len(at), len(at), 2), np.float32)
    for axis, first in enumerate((left, top)):
        along = step * (first + at + side / 2) - 0.5
        places[..., axis] = along if axis == 0 else along[:, None]
    return windows, places.reshape(-1, 2)


def _trials_of(layer: Floats, level: int, poses: Sequence[tuple[float, float]]) -> Trials:
    """A patch (side, side, 4), image and mask, in K poses."""
    side = WINDOW_PX >> level
    turned = np.empty((len(poses), side, side, 4), np.float32)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    for window, pose in zip(turned, poses, strict=True):
        motion = _motion(len(layer), side, *pose)
        cv2.warpAffine(
            layer, motion, (side, side), window, flags=flags, borderMode=cv2.BORDER_REPLICATE
        )
    planes = np.ascontiguousarray(turned.reshape(len(poses), -1, 4).transpose(0, 2, 1))
    colour, mask = planes[:, :3], planes[:, 3]
    mask /= np.maximum(mask.sum(axis=1, keepdims=True), 1e-6)
    mean = np.einsum("kcd,kd->kc", colour, mask)
    colour -= mean[..., None]
    centred = colour * mask[:, None]
    variance = np.einsum("kcd,kcd->k", centred, colour)
    return Trials(centred.reshape(len(poses), -1), mask, variance, mean)


def _motion(patch_px: int, side: int, turn: float, scale: float) -> NDArray[np.float64]:
    """Map (2, 3) from a window's pixels to those of a patch that is turned and scaled in it."""
    c, s = cos(turn) / scale, sin(turn) / scale
    inner, outer = (side - 1) / 2, (patch_px - 1) / 2
    return np.array([[c, -s, outer - (c - s) * inner], [s, c, outer - (c + s) * inner]])


def _wrapped(angle: float) -> float:
    """An angle [rad] in (-π, π]."""
    return float(np.pi - (np.pi - angle) % (2 * np.pi))
