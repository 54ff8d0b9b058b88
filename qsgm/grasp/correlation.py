"""Lay the demonstration's patch over a scene: where, how far turned and how large it fits best.

Masked, normalised colour correlation: of the patch only the object's pixels count, each channel
around its own mean, so that neither the table nor the light matters. One correlation over all of
the object is ruled by what hides a part of it, so most of the score is what its parts say, each
by itself. Coarse to fine: at an eighth of the resolution every turn and a few scales are tried at
every place within 16 px of a candidate; the best few go on to a quarter of it. All trials of one
level are a few matrix products.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from math import cos, radians, sin

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.patch import PATCH_PX, Patch, mirrored_square

Floats = NDArray[np.float32]

WINDOW_PX = 128
# Halvings of the resolution, coarse to fine.
COARSE, MIDDLE, FINE = 3, 2, 1
_STRIP_ROWS = 32  # halved at once
SCALES = (0.85, 1.0, 1.18)
# Variance [levels²] that a flat surface's noise has anyway: without it noise correlates with noise.
NOISE_VARIANCE = 30.0

_COARSE_POSES = tuple(
    (float(turn), scale) for scale in SCALES for turn in np.deg2rad(np.arange(0, 360, 15))
)
_ALL_COARSE = frozenset(_COARSE_POSES)
_COARSE_REACH = 2  # px of the level
_MIDDLE_TURNS = (-radians(6), 0.0, radians(6))
_MIDDLE_SCALES, _MIDDLE_REACH = (0.93, 1.0, 1.07), 2
# Turns that differ by less are the same hypothesis.
_SAME_TURN = np.deg2rad(25)
_STARTS = 3
# Parts of a window, across and down: 32 px of the frame each.
_PARTS = 4
# What their own agreement counts; the rest is that of the whole.
_PARTS_COUNT = np.float32(2 / 3)
_ALL_PARTS = np.arange(_PARTS**2)
_TINY = 1e-9


# Turn [rad], scale.
Pose = tuple[float, float]


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
    """Half of an image, strip by strip: the whole of it as floats is four times as large.

    A fourth channel, of nothing, makes it four times as quick: with three OpenCV goes number by
    number. All sums are exact.
    """
    height, width = (max(side // 2, 1) for side in image.shape[:2])
    even = image[: 2 * height, : 2 * width]  # else a pixel would be of a little more
    halved = np.empty((height, width, 3), np.float32)
    rows, half = (np.empty((k * _STRIP_ROWS, k * width, 4), np.float32) for k in (2, 1))
    for top in range(0, height, _STRIP_ROWS):
        strip = halved[top : top + _STRIP_ROWS]
        count = len(strip)
        rows[: 2 * count] = cv2.cvtColor(even[2 * top : 2 * (top + count)], cv2.COLOR_BGR2BGRA)
        size = (width, count)
        cv2.resize(rows[: 2 * count], size, half[:count], interpolation=cv2.INTER_AREA)
        cv2.cvtColor(half[:count], cv2.COLOR_BGRA2BGR, strip)
    return halved


@dataclass(frozen=True)
class Trials:
    """K turned and scaled patches at one level, each cut into P parts of E pixels.

    Parts that show nothing of the object in any of them are left out.
    """

    live: NDArray[np.intp]  # (P,), which of the window's parts these are
    coloured: Floats  # (P, 3 E, K): the pixel times its mask
    mask: Floats  # (P, E, K), sums to 1 in each part
    share: Floats  # (P, K), of the object's pixels, sums to 1
    mean: Floats  # (P, 3, K)
    variance: Floats  # (P, K)
    whole_mean: Floats  # (3, K)
    whole_variance: Floats  # (K,)

    @staticmethod
    def of(patches: Floats) -> "Trials":
        """From patches (16, K, 4, E), image and mask, as :func:`in_parts` cuts them."""
        covered = patches[:, :, 3].sum(axis=2)
        live = np.flatnonzero(covered.any(axis=1))
        if not len(live):
            live = _ALL_PARTS
        patches, covered = patches[live], covered[live]
        colour, mask = patches[:, :, :3], patches[:, :, 3]
        share = covered / np.maximum(covered.sum(axis=0), _TINY)
        weight = mask / np.maximum(covered, _TINY)[..., None]
        weighed = colour * weight[:, :, None]
        mean = np.ascontiguousarray(weighed.sum(axis=3).transpose(0, 2, 1))
        square = np.einsum("pkce,pkce->pk", weighed, colour)
        whole_mean = np.einsum("pck,pk->ck", mean, share)
        whole_square = np.einsum("pk,pk->k", square, share)
        return Trials(
            live,
            weighed.reshape(*share.shape, -1).transpose(0, 2, 1),
            weight.transpose(0, 2, 1),
            share,
            mean,
            np.maximum(square - (mean * mean).sum(axis=1), 0),
            whole_mean,
            np.maximum(whole_square - (whole_mean * whole_mean).sum(axis=0), 0),
        )


@dataclass(frozen=True)
class Template:
    """A patch, ready to be laid over scenes; what all of them need of it is kept."""

    patch: Patch
    _coarse: list[Trials] = field(default_factory=list)
    _middle: dict[Pose, Trials] = field(default_factory=dict)
    _layers: dict[int, Floats] = field(default_factory=dict)

    def trials(self, level: int, poses: Sequence[Pose]) -> Trials:
        """The patch in every pose, side by side."""
        side, layer = WINDOW_PX >> level, self.layer(level)
        turned = np.empty((len(poses), side, side, 4), np.float32)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        for window, pose in zip(turned, poses, strict=True):
            motion = _motion(len(layer), side, *pose)
            border = cv2.BORDER_REPLICATE
            cv2.warpAffine(layer, motion, (side, side), window, flags=flags, borderMode=border)
        return Trials.of(in_parts(turned))

    def coarse_trials(self) -> Trials:
        """The patch in all coarse poses."""
        if not self._coarse:
            self._coarse.append(self.trials(COARSE, _COARSE_POSES))
        return self._coarse[0]

    def middle_trials(self, around: Pose) -> tuple[Trials, list[Pose]]:
        """The patch in poses around one, kept if that is a coarse one, and those poses."""
        turn, scale = around
        poses = [(turn + more, scale * s) for s in _MIDDLE_SCALES for more in _MIDDLE_TURNS]
        trials = self._middle.get(around) or self.trials(MIDDLE, poses)
        if around in _ALL_COARSE:
            self._middle[around] = trials
        return trials, poses

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
    starts = []
    for center in centers_px:
        windows, places = windows_around(scene, COARSE, center, _COARSE_REACH, trials.live)
        starts.append(_distinct(agreement(windows, trials), places, _COARSE_POSES))
    return starts


def middle_fit(template: Template, scene: Pyramid, start: Fit) -> Fit:
    """A coarse fit at a quarter of the resolution."""
    trials, poses = template.middle_trials((start.turn_rad, start.scale))
    windows, places = windows_around(scene, MIDDLE, start.center_px, _MIDDLE_REACH, trials.live)
    return _best(agreement(windows, trials), places, poses)


def _best(scores: Floats, places: Floats, poses: Sequence[Pose]) -> Fit:
    """The best of K poses at A places, by their scores (A, K)."""
    place, pose = divmod(int(scores.argmax()), len(poses))
    x, y = places[place].tolist()
    return Fit(float(scores[place, pose]), *poses[pose], (x, y))


def _distinct(scores: Floats, places: Floats, poses: Sequence[Pose]) -> list[Fit]:
    """The best trials whose turns differ, as starts for the next level."""
    best = scores.max(axis=0)
    starts: list[Fit] = []
    for pose in np.argsort(-best, kind="stable").tolist():
        turn, scale = poses[pose]
        if all(abs(_wrapped(turn - start.turn_rad)) > _SAME_TURN for start in starts):
            x, y = places[int(scores[:, pose].argmax())].tolist()
            starts.append(Fit(float(best[pose]), turn, scale, (x, y)))
        if len(starts) == _STARTS:
            break
    return starts


@dataclass(frozen=True)
class _Compared:
    """A windows under each of K masks, part by part: means of what is seen there."""

    mean: Floats  # (P, A, 3, K), of each channel
    square: Floats  # (P, A, K), of all channels' squares together
    product: Floats  # (P, A, K), of what is seen times the patch

    @staticmethod
    def of(windows: Floats, trials: Trials) -> "_Compared":
        """Compare windows (P, A, 3, E)."""
        parts, count, channels, pixels = windows.shape
        mean = windows.reshape(parts, -1, pixels) @ trials.mask
        square = np.einsum("pace,pace->pae", windows, windows) @ trials.mask
        product = windows.reshape(parts, count, -1) @ trials.coloured
        return _Compared(mean.reshape(parts, count, channels, -1), square, product)

    def whole(self, trials: Trials) -> Floats:
        """Correlation of all parts as one image (A, K)."""
        mean = np.einsum("pack,pk->ack", self.mean, trials.share)
        square = np.einsum("pak,pk->ak", self.square, trials.share)
        product = np.einsum("pak,pk->ak", self.product, trials.share)
        variance = np.maximum(square - np.einsum("ack,ack->ak", mean, mean), 0)
        product -= np.einsum("ack,ck->ak", mean, trials.whole_mean)
        noisy = (variance + NOISE_VARIANCE) * (trials.whole_variance + NOISE_VARIANCE)
        return np.asarray(product / np.sqrt(noisy), dtype=np.float32)

    def by_parts(self, trials: Trials) -> Floats:
        """What the parts' own correlations come to (A, K), each as it covers the object."""
        noisy = self.square - np.einsum("pack,pack->pak", self.mean, self.mean)
        np.maximum(noisy, 0, out=noisy)
        noisy += NOISE_VARIANCE
        noisy *= (trials.variance + NOISE_VARIANCE)[:, None]
        scores = self.product - np.einsum("pack,pck->pak", self.mean, trials.mean)
        scores /= np.sqrt(noisy, out=noisy)
        np.maximum(scores, 0, out=scores)
        return np.asarray(np.einsum("pak,pk->ak", scores, trials.share), dtype=np.float32)


def agreement(windows: Floats, trials: Trials) -> Floats:
    """How well windows (P, A, 3, E) fit K trials, at most 1: at once, and part by part (A, K).

    A part that disagrees counts nothing, however much it disagrees.
    """
    compared = _Compared.of(windows, trials)
    whole = compared.whole(trials)
    return whole + _PARTS_COUNT * (compared.by_parts(trials) - whole)


def correlate(windows: Floats, trials: Trials) -> Floats:
    """Masked colour correlation (A, K) of windows (P, A, 3, E) with K trials."""
    return _Compared.of(windows, trials).whole(trials)


def in_parts(images: Floats) -> Floats:
    """Square images (N, side, side, M) cut into parts (P, N, M, E)."""
    count, side, _, planes = images.shape
    cell = side // _PARTS
    cut = images.reshape(count, _PARTS, cell, _PARTS, cell, planes).transpose(1, 3, 0, 5, 2, 4)
    return np.ascontiguousarray(cut).reshape(_PARTS**2, count, planes, cell * cell)


def windows_around(
    scene: Pyramid,
    level: int,
    center_px: tuple[float, float],
    reach: int,
    live: NDArray[np.intp] = _ALL_PARTS,
) -> tuple[Floats, Floats]:
    """All windows of a level within `reach` pixels of a point.

    Args:
        scene: the frame.
        level: how often it is halved.
        center_px: the point.
        reach: right and down together.
        live: which P parts of each window are wanted.

    Returns:
        Windows (P, A, 3, E), cut as :func:`in_parts` does, and their centres (A, 2) [px of the
        frame]; beyond its border the frame is mirrored.
    """
    side, step = WINDOW_PX >> level, 1 << level
    wide, cell = side + 2 * reach, side // _PARTS
    left, top = (round((value + 0.5) / step - side / 2) - reach for value in center_px)
    square = mirrored_square(scene.level(level), left, top, wide)
    planes = np.ascontiguousarray(square.transpose(2, 0, 1))
    # A look at every part of every window of the square; those that are wanted are copied.
    plane, row, column = planes.strides
    steps = wide - side + 1
    shape = (_PARTS, _PARTS, steps, steps, 3, cell, cell)
    strides = (cell * row, cell * column, row, column, plane, row, column)
    down, right, offsets = _diamond(reach)
    rows, columns = np.divmod(live[:, None], _PARTS)
    parts = np.ndarray(shape, np.float32, planes, strides=strides)[rows, columns, down, right]
    first = np.array([step * (at + side / 2) - 0.5 for at in (left, top)], np.float32)
    return parts.reshape(len(live), len(down), 3, cell * cell), first + step * offsets


@cache
def _diamond(reach: int) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
    """What is at most `reach` steps from the middle of a square: rows, columns, both (A, 2)."""
    at = np.abs(np.arange(-reach, reach + 1))
    down, right = np.nonzero(at[:, None] + at <= reach)
    return down, right, np.stack([right, down], axis=1).astype(np.float32)


def _motion(patch_px: int, side: int, turn: float, scale: float) -> NDArray[np.float64]:
    """Map (2, 3) from a window's pixels to those of a patch that is turned and scaled in it."""
    c, s = cos(turn) / scale, sin(turn) / scale
    inner, outer = (side - 1) / 2, (patch_px - 1) / 2
    return np.array([[c, -s, outer - (c - s) * inner], [s, c, outer - (c + s) * inner]])


def _wrapped(angle: float) -> float:
    """An angle [rad] in (-π, π]."""
    return float(np.pi - (np.pi - angle) % (2 * np.pi))
