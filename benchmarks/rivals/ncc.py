"""Rotated colour NCC in a pyramid: the object, masked, at every angle, coarse to fine.

Called as `ncc.py FOLDER ANSWERS.json`; qsgm/bench/rivals.py says what lies in the folder. The
template is given the object's true mask, which no user has at hand. Needs numpy and cv2.
"""

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

COARSE_LEVEL = 2  # a quarter of the size
COARSE_STEP_DEG = 5.0
SCALES = (1.0,)
CANDIDATES = 8
RIM_PX = 2  # of the object's outline, beyond its mask
# Windows flatter than this share of the template count as if they were not, so that noise
# on an empty table does not correlate.
LEAST_CONTRAST = 0.15


@dataclass(frozen=True)
class Pose:
    """Where the template lies."""

    score: float
    x: float  # of the template's middle, in the scene
    y: float
    turn_deg: float  # counter-clockwise
    scale: float


class Template:
    """The object of a demonstration, to be turned and scaled."""

    def __init__(self, frame: np.ndarray, mask: np.ndarray) -> None:
        rows, cols = np.nonzero(mask)
        self.center = np.array([cols.mean(), rows.mean()])
        reach = np.hypot(cols - self.center[0], rows - self.center[1]).max()
        self.radius = float(reach) + RIM_PX + 1
        disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * RIM_PX + 1, 2 * RIM_PX + 1))
        self.mask = cv2.dilate(mask.astype(np.uint8), disk).astype(np.float32)
        self.frames, self.masks = [frame.astype(np.float32)], [self.mask]
        for _ in range(COARSE_LEVEL):
            self.frames.append(cv2.pyrDown(self.frames[-1]))
            self.masks.append(cv2.pyrDown(self.masks[-1]))

    def turned(self, level: int, turn_deg: float, scale: float) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (s, s, 3) and mask (s, s) at a level of the pyramid; the middle is the centre."""
        half = int(np.ceil(self.radius * scale / 2**level)) + 1
        motion = cv2.getRotationMatrix2D(tuple(self.center / 2**level), turn_deg, scale)
        motion[:, 2] += half - self.center / 2**level
        size = (2 * half + 1, 2 * half + 1)
        pixels = cv2.warpAffine(
            self.frames[level],
            motion,
            size,
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        mask = cv2.warpAffine(self.masks[level], motion, size, flags=cv2.INTER_LINEAR)
        return pixels, (mask > 0.5).astype(np.float32)


def ncc(image: np.ndarray, pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Masked correlation of every window of an image, each channel's mean taken off."""
    count = max(float(mask.sum()), 1.0)
    weights = np.repeat(mask[:, :, None], 3, axis=2)
    mean = (pixels * weights).sum(axis=(0, 1)) / count
    centred = ((pixels - mean) * weights).astype(np.float32)
    norm = float(np.sqrt((centred**2).sum())) + 1e-6
    product = cv2.matchTemplate(image, centred, cv2.TM_CCORR)
    energy = cv2.matchTemplate(image * image, weights, cv2.TM_CCORR)
    for channel in cv2.split(image):
        energy -= cv2.matchTemplate(channel, mask, cv2.TM_CCORR) ** 2 / count
    contrast = np.sqrt(np.maximum(energy, 0))
    return product / (norm * np.maximum(contrast, LEAST_CONTRAST * norm))


class Scene:
    """A scene's pyramid, with a border for templates that reach beyond it."""

    def __init__(self, frame: np.ndarray) -> None:
        self.pad = 16
        border = cv2.BORDER_REPLICATE
        padded = cv2.copyMakeBorder(frame, *(4 * [self.pad]), border).astype(np.float32)
        # Centred values keep the sums of squares small.
        self.levels = [padded - 128]
        for _ in range(COARSE_LEVEL):
            self.levels.append(cv2.pyrDown(self.levels[-1]))


def coarse(scene: Scene, templates: list) -> list[Pose]:
    """The best places at the coarsest level, each with its best angle."""
    level = COARSE_LEVEL
    height, width = scene.levels[level].shape[:2]
    best = np.full((height, width), -1.0, np.float32)
    which = np.zeros((height, width), np.int32)
    for i, (_, _, pixels, mask) in enumerate(templates):
        answer = ncc(scene.levels[level], pixels, mask)
        half = pixels.shape[0] // 2
        part = np.s_[half : half + answer.shape[0], half : half + answer.shape[1]]
        better = answer > best[part]
        best[part] = np.where(better, answer, best[part])
        which[part] = np.where(better, i, which[part])
    found = []
    for _ in range(CANDIDATES):
        y, x = np.unravel_index(int(best.argmax()), best.shape)
        turn, scale = templates[which[y, x]][:2]
        found.append(Pose(float(best[y, x]), float(x), float(y), turn, scale))
        cv2.circle(best, (int(x), int(y)), 4, -1.0, cv2.FILLED)
    return found


def finer(
    scene: Scene, template: Template, level: int, pose: Pose, turns: np.ndarray, reach: int
) -> Pose:
    """The best pose near one, at a level; `pose` is in that level's pixels."""
    image = scene.levels[level]
    best, scores = pose, []
    for turn in turns:
        pixels, mask = template.turned(level, pose.turn_deg + turn, pose.scale)
        half = pixels.shape[0] // 2
        left, top = round(pose.x) - half - reach, round(pose.y) - half - reach
        left, top = max(left, 0), max(top, 0)
        part = image[top : top + 2 * (half + reach) + 1, left : left + 2 * (half + reach) + 1]
        if min(part.shape[:2]) < pixels.shape[0]:
            scores.append(-1.0)
            continue
        answer = ncc(part, pixels, mask)
        y, x = np.unravel_index(int(answer.argmax()), answer.shape)
        scores.append(float(answer[y, x]))
        if answer[y, x] > best.score or best is pose:
            right, down = peak(answer[y], x), peak(answer[:, x], y)
            best = Pose(
                float(answer[y, x]),
                left + half + right,
                top + half + down,
                pose.turn_deg + float(turn),
                pose.scale,
            )
    k = int(np.argmax(scores))
    step = float(turns[1] - turns[0])
    turn = pose.turn_deg + float(turns[0]) + step * peak(np.array(scores), k)
    return Pose(best.score, best.x, best.y, turn, best.scale)


def peak(values: np.ndarray, k: int) -> float:
    """The top of a parabola through the largest value and its neighbours."""
    if not 0 < k < len(values) - 1:
        return float(k)
    before, here, after = (float(v) for v in values[k - 1 : k + 2])
    bend = before - 2 * here + after
    return k + (0.5 * (before - after) / bend if bend < -1e-9 else 0.0)


def locate(scene: Scene, template: Template, templates: list) -> Pose:
    """The best pose in a scene."""
    poses = coarse(scene, templates)
    for level, turns, reach, keep in (
        (1, np.arange(-4.0, 4.1, 2.0), 3, 3),
        (0, np.arange(-2.0, 2.1, 1.0), 3, 1),
    ):
        doubled = [Pose(p.score, 2 * p.x, 2 * p.y, p.turn_deg, p.scale) for p in poses]
        refined = [finer(scene, template, level, p, turns, reach) for p in doubled]
        poses = sorted(refined, key=lambda p: -p.score)[:keep]
    return finer(scene, template, 0, poses[0], np.arange(-0.5, 0.6, 0.25), 1)


def main(folder: Path, output: Path) -> None:
    """Teach on the folder's demonstration, look for the object in its scenes."""
    cv2.setNumThreads(1)
    listing = json.loads((folder / "scenes.json").read_text())
    frame = cv2.imread(str(folder / listing["demonstration"]))
    mask = cv2.imread(str(folder / listing["mask"]), cv2.IMREAD_GRAYSCALE) > 127
    template = Template(frame, mask)
    turns = np.arange(0.0, 360.0, COARSE_STEP_DEG)
    templates = [
        (float(turn), scale, *template.turned(COARSE_LEVEL, turn, scale))
        for scale in SCALES
        for turn in turns
    ]
    offset = np.array(listing["center_px"]) - template.center
    answers = []
    for file in listing["scenes"]:
        picture = cv2.imread(str(folder / file))
        began = time.perf_counter()
        scene = Scene(picture)
        pose = locate(scene, template, templates)
        seconds = time.perf_counter() - began
        angle = np.radians(pose.turn_deg)
        rotation = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        x, y = np.array([pose.x, pose.y]) - scene.pad + pose.scale * rotation @ offset
        turn = (pose.turn_deg + 180) % 360 - 180
        answers.append(
            {
                "file": file,
                "score": pose.score,
                "center_px": [float(x), float(y)],
                "turn_deg": turn,
                "seconds": seconds,
            }
        )
    output.write_text(json.dumps({"answers": answers}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
