"""A made-up object with markings, laid into frames exactly where a test wants it."""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.bundle import Bundle
from qsgm.grasp.decision import Decision
from qsgm.grasp.evidence import NAMES

Frame = NDArray[np.uint8]
SIDE = 480  # of the object's own picture, which is 4 times as large as it is seen
SHARP = 4


def toy(front: bool = True) -> NDArray[np.float32]:
    """A rounded box (480, 480, 4), BGR and opacity, 90 x 36 px as it is seen, lying along x.

    Args:
        front: whether its two ends differ.
    """
    picture = np.zeros((SIDE, SIDE, 4), np.float32)
    middle = SIDE // 2
    box = np.array([[-150, -72], [150, -72], [150, 72], [-150, 72]]) + middle
    cv2.fillConvexPoly(picture, box.astype(np.int32), (60, 70, 200, 255))
    for x in (-150, 150):
        cv2.circle(picture, (middle + x, middle), 30, (60, 70, 200, 255), cv2.FILLED)
    for x, y in ((-60, -40), (60, 40)):
        cv2.circle(picture, (middle + x, middle + y), 22, (230, 230, 230, 255), cv2.FILLED)
    if front:
        cv2.rectangle(
            picture,
            (middle + 100, middle - 60),
            (middle + 150, middle + 60),
            (40, 200, 230, 255),
            -1,
        )
    return picture


def plain() -> NDArray[np.float32]:
    """A spanner's outline of one colour, 90 px long: nothing on it says where it is."""
    picture = np.zeros((SIDE, SIDE, 4), np.float32)
    middle, steel = SIDE // 2, (200, 205, 210, 255)
    cv2.rectangle(picture, (middle - 170, middle - 22), (middle + 170, middle + 22), steel, -1)
    cv2.circle(picture, (middle + 150, middle), 52, steel, cv2.FILLED)
    return picture


def table(seed: int = 0, frame_hw: tuple[int, int] = (480, 640), grey: float = 120) -> Frame:
    """A grey table with grain."""
    rng = np.random.default_rng(seed)
    grain = cv2.GaussianBlur(rng.normal(0, 20, (*frame_hw, 3)), (0, 0), 2)
    light = np.linspace(0, 25, frame_hw[1])[None, :, None]
    return np.clip(grey + light + grain, 0, 255).astype(np.uint8)


def lay(
    picture: NDArray[np.float32],
    on: Frame,
    center_px: tuple[float, float],
    turn_deg: float = 0.0,
    scale: float = 1.0,
    light: float = 1.0,
) -> Frame:
    """A frame with the object at a point (x, y), turned counter-clockwise.

    The object is averaged over 4 x 4 places within every pixel, so that it lies between pixels as
    well as on them.
    """
    height, width = on.shape[:2]
    turn = np.deg2rad(turn_deg)
    cos, sin = scale / SHARP * np.cos(turn), scale / SHARP * np.sin(turn)
    linear = SHARP * np.array([[cos, sin], [-sin, cos]])
    center = SHARP * (np.array(center_px) + 0.5) - 0.5
    shift = center - linear @ np.full(2, SIDE / 2)
    motion = np.concatenate([linear, shift[:, None]], axis=1)
    ready = picture.copy()
    ready[..., :3] *= ready[..., 3:] / 255
    fine = cv2.warpAffine(ready, motion, (SHARP * width, SHARP * height), flags=cv2.INTER_LINEAR)
    layer = cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA)
    mixed = on * (1 - layer[..., 3:] / 255) + light * layer[..., :3]
    return np.clip(np.rint(mixed), 0, 255).astype(np.uint8)


def by_correlation(threshold: float = 0.6, steepness: float = 20.0) -> Decision:
    """Found is what correlates by more than so much."""
    facts = len(NAMES)
    hidden = np.zeros((2, facts), np.float32)
    hidden[0, 0], hidden[1, 0] = steepness, -steepness
    ones = np.ones(facts, np.float32)
    return Decision(
        np.zeros(facts, np.float32),
        ones,
        hidden,
        np.zeros(2, np.float32),
        np.array([1.0, -1.0], np.float32),
        0.0,
        steepness * threshold,
    )


def bump(
    centers_px: list[tuple[float, float]],
    frame_hw: tuple[int, int] = (480, 640),
    angle_rad: float = 0.0,
) -> NDArray[np.float32]:
    """A heatmap (3, rows, cols) that sees objects at some points, all lying at one angle."""
    rows, cols = ((side - 128) // 16 + 1 for side in frame_hw)
    y, x = np.mgrid[:rows, :cols] * 16 + 64
    quality = np.full((rows, cols), 0.01)
    for at_x, at_y in centers_px:
        off = np.hypot(x - at_x, y - at_y)
        quality = np.maximum(quality, 1 / (1 + np.exp((off - 18) / 3)))
    ones = np.ones((rows, cols))
    return np.stack([quality, np.sin(2 * angle_rad) * ones, np.cos(2 * angle_rad) * ones]).astype(
        np.float32
    )


def with_decision(bundle: Bundle, decision: Decision) -> Bundle:
    """The same bundle with another decision on what is the object."""
    task = bundle.manifest.task
    settings = {**task.settings, "decision": decision.to_json()}
    manifest = replace(bundle.manifest, task=replace(task, settings=settings))
    return replace(bundle, manifest=manifest)


def draw_frame(length: int = 90) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """A bar (or, of length 0, a disk) on a noisy table, and its mask."""
    rng = np.random.default_rng(0)
    table = np.array([120, 140, 160]) + cv2.GaussianBlur(
        rng.normal(0, 60, (480, 640, 3)), (0, 0), 3
    )
    mask = np.zeros((480, 640), np.uint8)
    along = np.array([np.cos(0.4), -np.sin(0.4)]) * length / 2
    ends = [tuple(int(v) for v in np.rint(np.array([320, 240]) + s * along)) for s in (-1, 1)]
    cv2.line(mask, ends[0], ends[1], 255, 26, cv2.LINE_AA)
    table[mask > 127] = (40, 60, 200)
    return np.clip(table, 0, 255).astype(np.uint8), np.where(mask > 127, 255, 0).astype(np.uint8)


def draw_things() -> NDArray[np.uint8]:
    """A sheet of two things, a green bar and a blue disk: (128, 256, 4) BGRA."""
    sheet = np.zeros((128, 256, 4), np.uint8)
    cv2.rectangle(sheet, (24, 52), (104, 76), (60, 200, 40, 255), cv2.FILLED)
    cv2.circle(sheet, (192, 64), 30, (220, 90, 30, 255), cv2.FILLED)
    return sheet
