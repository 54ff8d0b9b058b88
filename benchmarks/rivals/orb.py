"""ORB features and RANSAC: how many matches agree on one turn, shift and scale.

Called as `orb.py FOLDER ANSWERS.json`; qsgm/bench/rivals.py says what lies in the folder. Features
are taken on the object's true mask, which no user has at hand. Needs numpy and cv2.
"""

import json
import math
import sys
import time
from pathlib import Path

import cv2
import numpy as np

ENLARGED = 2  # objects are small for a detector of corners
RATIO = 0.8
REPROJECTION_PX = 4.0
SCALES = (0.6, 1.7)


class Finder:
    """An object's features."""

    def __init__(self, frame: np.ndarray, mask: np.ndarray, center: tuple[float, float]) -> None:
        self.few = cv2.ORB_create(800, fastThreshold=5, edgeThreshold=15)
        self.many = cv2.ORB_create(4000, fastThreshold=5, edgeThreshold=15)
        self.matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
        self.center = np.array([ENLARGED * center[0], ENLARGED * center[1], 1.0])
        where = cv2.dilate(mask.astype(np.uint8), np.ones((7, 7), np.uint8))
        where = cv2.resize(where, None, fx=ENLARGED, fy=ENLARGED, interpolation=cv2.INTER_NEAREST)
        self.points, self.features = self.few.detectAndCompute(enlarged(frame), where)

    def locate(self, scene: np.ndarray) -> tuple[float, list[float] | None, float]:
        """Score, centre and turn counter-clockwise; no centre where nothing agrees."""
        points, features = self.many.detectAndCompute(enlarged(scene), None)
        if self.features is None or features is None or len(points) < 2:
            return 0.0, None, 0.0
        pairs = self.matcher.knnMatch(self.features, features, k=2)
        good = [p[0] for p in pairs if len(p) == 2 and p[0].distance < RATIO * p[1].distance]
        if len(good) < 3:
            return 0.0, None, 0.0
        here = np.array([self.points[m.queryIdx].pt for m in good])
        there = np.array([points[m.trainIdx].pt for m in good])
        motion, inliers = cv2.estimateAffinePartial2D(
            here, there, method=cv2.RANSAC, ransacReprojThreshold=REPROJECTION_PX, maxIters=5000
        )
        if motion is None or not SCALES[0] < math.hypot(*motion[:, 0]) < SCALES[1]:
            return 0.0, None, 0.0
        x, y = motion @ self.center / ENLARGED
        # Among equally many, those that are a larger part of the matches.
        score = float(inliers.sum()) + float(inliers.mean())
        return score, [float(x), float(y)], math.degrees(math.atan2(-motion[1, 0], motion[0, 0]))


def enlarged(frame: np.ndarray) -> np.ndarray:
    """A frame (H, W, 3), grey and larger."""
    grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
    return cv2.resize(grey, None, fx=ENLARGED, fy=ENLARGED, interpolation=cv2.INTER_CUBIC)


def main(folder: Path, output: Path) -> None:
    """Teach on the folder's demonstration, look for the object in its scenes."""
    cv2.setNumThreads(1)
    cv2.setRNGSeed(0)
    listing = json.loads((folder / "scenes.json").read_text())
    frame = cv2.imread(str(folder / listing["demonstration"]))
    mask = cv2.imread(str(folder / listing["mask"]), cv2.IMREAD_GRAYSCALE) > 127
    finder = Finder(frame, mask, listing["center_px"])
    answers = []
    for file in listing["scenes"]:
        scene = cv2.imread(str(folder / file))
        began = time.perf_counter()
        score, center, turn = finder.locate(scene)
        seconds = time.perf_counter() - began
        answers.append(
            {
                "file": file,
                "score": score,
                "center_px": center,
                "turn_deg": turn,
                "seconds": seconds,
            }
        )
    output.write_text(json.dumps({"answers": answers}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
