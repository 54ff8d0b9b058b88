"""Lay the demonstration's patch over a scene: where, how far turned and how large it fits best.

Masked, normalised colour correlation: of the patch only the object's pixels count, each channel
around its own mean, so that neither the table nor the light matters. One correlation over all of
the object is ruled by what hides a part of it, so most of the score is what its parts say, each
by itself. Coarse to fine: at an eighth of the resolution every turn and a few scales are tried at
every place within 16 px of a candidate; the best few go on to a quarter of it. All trials of one
level are a few matrix products.
"""

import math
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
    (float(turn), scale) for scale in SCALES for turn in np.deg2rad(np.arange(0, 360, 15))
)
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
_TINY = 1e-9


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
class Parts:
    """K turned and scaled patches cut into P parts of E pixels, as columns of matrices."""

    centred: Floats  # (P, 3 E, K): pixel minus the part's mean, times its mask
    mask: Floats  # (P, E, K), sums to 1 in each part
    share: Floats  # (P, K), of the object's pixels, sums to 1
    variance: Floats  # (P, K)

    @staticmethod
    def of(colour: Floats, mask: Floats) -> "Parts":
        """Cut patches (K, 3, D) with masks (K, D) that sum to 1."""
        pixels, covered = _in_parts(colour), _in_parts(mask[:, None])[:, :, 0]
        share = covered.sum(axis=2)
        weight = covered / np.maximum(share, _TINY)[..., None]
        pixels = pixels - np.einsum("pkce,pke->pkc", pixels, weight)[..., None]
        centred = pixels * weight[:, :, None]
        variance = np.einsum("pkce,pkce->pk", centred, pixels)
        columns = centred.reshape(*share.shape, -1).transpose(0, 2, 1)
        return Parts(
            np.ascontiguousarray(columns),
            np.ascontiguousarray(weight.transpose(0, 2, 1)),
            share,
            variance,
        )


@dataclass(frozen=True)
class Trials:
    """K turned and scaled patches at one level, as rows of matrices."""

    centred: Floats  # (K, 3 D): pixel minus mean, times the mask
    mask: Floats  # (K, D), sums to 1
    variance: Floats  # (K,)
    mean: Floats  # (K, 3)
    parts: Parts


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
    scores = agreement(np.concatenate([windows for windows, _ in around]), trials)
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
    """Agreement (A, K) of K poses at A places, and the places (A, 2) [px of the frame]."""
    trials = template.trials(level, poses)
    windows, places = windows_around(scene, level, center_px, reach)
    return agreement(windows, trials), places


def agreement(windows: Floats, trials: Trials) -> Floats:
    """How well windows (A, 3, D) fit K trials, at most 1: all at once, and part by part (A, K).

    A part that disagrees counts nothing, however much it disagrees.
    """
    whole, _, _ = correlate(windows, trials)
    apart = _by_parts(windows, trials.parts)
    return np.asarray(whole + _PARTS_COUNT * (apart - whole), dtype=np.float32)


def _by_parts(windows: Floats, parts: Parts) -> Floats:
    """What the parts' own correlations come to (A, K), each counting as it covers the object."""
    seen = _in_parts(windows)
    count, places, channels, pixels = seen.shape
    mean = (seen.reshape(count, -1, pixels) @ parts.mask).reshape(count, places, channels, -1)
    variance = np.einsum("pace,pace->pae", seen, seen) @ parts.mask
    variance -= np.einsum("pack,pack->pak", mean, mean)
    noisy = np.maximum(variance, 0, out=variance)
    noisy += NOISE_VARIANCE
    noisy *= (parts.variance + NOISE_VARIANCE)[:, None]
    product = seen.reshape(count, places, -1) @ parts.centred
    product /= np.sqrt(noisy, out=noisy)
    np.maximum(product, 0, out=product)
    return np.asarray(np.einsum("pak,pk->ak", product, parts.share), dtype=np.float32)


def _in_parts(images: Floats) -> Floats:
    """Square images (N, M, D) cut into parts (P, N, M, E)."""
    count, planes, pixels = images.shape
    cell = math.isqrt(pixels) // _PARTS
    cut = images.reshape(count, planes, _PARTS, cell, _PARTS, cell).transpose(2, 4, 0, 1, 3, 5)
    return np.ascontiguousarray(cut).reshape(_PARTS**2, count, planes, cell * cell)


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
    down, right = _diamond(reach)
    windows = np.ascontiguousarray(views[:, down, right].swapaxes(0, 1))
    corner = np.stack([left + right, top + down], axis=1)
    places = (step * (corner + side / 2) - 0.5).astype(np.float32)
    return windows.reshape(len(places), 3, side * side), places


def _diamond(reach: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of what is at most `reach` steps from the middle of a square."""
    at = np.abs(np.arange(-reach, reach + 1))
    down, right = np.nonzero(at[:, None] + at <= reach)
    return down, right


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
    parts = Parts.of(colour, mask)
    mean = np.einsum("kcd,kd->kc", colour, mask)
    colour -= mean[..., None]
    centred = colour * mask[:, None]
    variance = np.einsum("kcd,kcd->k", centred, colour)
    return Trials(centred.reshape(len(poses), -1), mask, variance, mean, parts)


def _motion(patch_px: int, side: int, turn: float, scale: float) -> NDArray[np.float64]:
    """Map (2, 3) from a window's pixels to those of a patch that is turned and scaled in it."""
    c, s = cos(turn) / scale, sin(turn) / scale
    inner, outer = (side - 1) / 2, (patch_px - 1) / 2
    return np.array([[c, -s, outer - (c - s) * inner], [s, c, outer - (c + s) * inner]])


def _wrapped(angle: float) -> float:
    """An angle [rad] in (-π, π]."""
    return float(np.pi - (np.pi - angle) % (2 * np.pi))
