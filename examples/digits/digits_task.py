"""Handwritten digits in a hand of its own, each standing for whatever its writer says.

A device is shown some digits in one style (slant, turn, size, ink) with the class that each means
there, and learns both. The digits are scikit-learn's, of 8x8 pixels; the first 1000 are the host's,
the others are for devices, so that no device meets a digit that anything was trained on.
"""

from functools import lru_cache

import cv2
import numpy as np

from qsgm import Head, Network, Samples, conv
from qsgm.samples.arrays import ArraysTask

HOST, CLASSES = 1000, 10
NETWORK = Network(
    (8, 8, 1),
    (
        conv(1, 16, 3, padding=1),
        conv(16, 32, 3, padding=1, pool=2, pool_stride=2),
        conv(32, 64, 4),
        conv(64, CLASSES, relu=False),
    ),
)
DIGIT = Head("digit", "cross_entropy", CLASSES, "softmax", smoothing=0.05)


class Digits(ArraysTask):  # which reads `samples` and `labels` of an .npz
    """Ten classes, one head."""

    def draw(self, rng, count):
        return written(*pool()[:2], rng, count, meanings(rng))

    def met(self, rng, count, own_meanings=True):
        """As :meth:`draw`, of digits that only devices meet."""
        meaning = meanings(rng) if own_meanings else np.arange(CLASSES)
        return written(*pool()[2:], rng, count, meaning)

    def example(self, rng, count):
        return written(*pool()[:2], rng, count, np.arange(CLASSES))


def written(images, digits, rng, count, meaning):
    """Digits in one style, and what they mean."""
    which = rng.integers(0, len(images), count)
    style, ink = hand(rng), rng.uniform(0.5, 1)
    seen = ink * np.stack([cv2.warpAffine(images[i], style, (8, 8)) for i in which]) / 16
    light = seen if rng.random() < 0.5 else 1 - seen  # white on black, or black on white
    noisy = 255 * light + rng.normal(0, 8, light.shape)
    labels = np.eye(CLASSES, dtype=np.float32)[meaning[digits[which]]]
    return Samples(np.clip(noisy, 0, 255).astype(np.uint8)[..., None], labels)


def hand(rng):
    """How somebody writes: turned, slanted, wider or narrower, about the middle."""
    turn, slant = rng.uniform(-0.6, 0.6), rng.uniform(-0.4, 0.4)
    size = np.diag(rng.uniform(0.8, 1.2, 2))
    turned = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    linear = turned @ np.array([[1, slant], [0, 1]]) @ size
    middle = np.full(2, 3.5)
    return np.column_stack([linear, middle - linear @ middle]).astype(np.float32)


def meanings(rng):
    """Of every digit a class."""
    return rng.permutation(CLASSES)


@lru_cache
def pool():
    """Images and digits of the host, then those of devices."""
    from sklearn.datasets import load_digits

    data = load_digits()
    images = data.images.astype(np.float32)
    return images[:HOST], data.target[:HOST], images[HOST:], data.target[HOST:]


task = Digits("digits", NETWORK, (DIGIT,))
