"""A task that has nothing to do with grasping: ten shapes, and what they mean to somebody.

Four layers, ten classes, cross entropy. A lesson shows all shapes in one style (slant, width, ink),
and some pairs of them mean each other, which is what a device has to learn.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.network import Network, conv
from qsgm.task import Head, Rows

SIDE, SHAPES = 16, 10
GLYPHS = np.random.default_rng(4).integers(0, 2, (SHAPES, 5, 5)).astype(np.uint8)

NETWORK = Network(
    (SIDE, SIDE, 1),
    (
        conv(1, 8, 3, stride=2),
        conv(8, 12, 3, padding=1, pool=2, pool_stride=2),
        conv(12, 16, 3),
        conv(16, SHAPES, relu=False),
    ),
)
SHAPE = Head("shape", "cross_entropy", SHAPES, "softmax", smoothing=0.05)


@dataclass(frozen=True)
class ToyLesson:
    """Samples of one style, with their labels from the start."""

    pixels: NDArray[np.uint8]  # (N, 16, 16, 1)
    labels: NDArray[np.float32]  # (N, 10)
    taught: int

    def __len__(self) -> int:
        return len(self.labels)

    def cut(self, rows: Rows) -> NDArray[np.uint8]:
        return self.pixels[rows]

    def labelled(self, untouched: NDArray[np.float32]) -> "ToyLesson":  # noqa: ARG002
        return self

    def scores(self, outputs: NDArray[np.float32], rows: Rows) -> dict[str, float | None]:
        return dict(ToyTask().scores(outputs, self.labels[rows]))


@dataclass(frozen=True)
class ToyTask:
    name: str = "toy"
    network: Network = NETWORK
    heads: tuple[Head, ...] = (SHAPE,)

    def to_json(self) -> dict[str, Any]:
        return {}

    def scores(self, outputs: NDArray[np.float32], labels: NDArray[np.float32]) -> dict[str, float]:
        return {"accuracy": float(np.mean(outputs.argmax(axis=1) == labels.argmax(axis=1)))}

    def lesson(self, rng: np.random.Generator, count: int) -> ToyLesson:
        swapped = np.repeat(rng.integers(0, 2, SHAPES // 2), 2)
        return self._lesson(rng, count, np.arange(SHAPES) ^ swapped)

    def example(
        self, rng: np.random.Generator, count: int
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        lesson = self._lesson(rng, count, np.arange(SHAPES))
        return lesson.pixels, lesson.labels

    def _lesson(
        self, rng: np.random.Generator, count: int, meaning: NDArray[np.int64]
    ) -> ToyLesson:
        style = rng.uniform(-0.5, 0.5, 2), rng.uniform(2, 3), rng.uniform(60, 120)
        which = rng.permutation(np.arange(count) % SHAPES)
        pixels = np.stack([*drawn(which, style, rng)])[..., None]
        labels = np.eye(SHAPES, dtype=np.float32)[meaning[which]]
        return ToyLesson(pixels, labels, count * 4 // 5)


def drawn(
    which: NDArray[np.int64], style: tuple[Any, float, float], rng: np.random.Generator
) -> Iterator[NDArray[np.uint8]]:
    """Every shape of a list in one style, somewhere near the middle."""
    (slant, lean), width, ink = style
    for one in which:
        x, y = SIDE / 2 - 2.5 * width + rng.uniform(-1, 1, 2)
        place = np.array([[width, slant, x], [lean, width, y]], np.float32)
        shape = cv2.warpAffine(GLYPHS[one] * 255, place, (SIDE, SIDE)).astype(np.float32) / 255
        noise = rng.normal(0, 8, (SIDE, SIDE))
        yield np.clip(128 + ink * shape - 60 + noise, 0, 255).astype(np.uint8)
