"""One taught object as a lesson: its crops, their labels, what held-out crops say."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.angles import AngleEncoding, angle_error, decode_angle, mean_direction
from qsgm.grasp.clutter import Addition
from qsgm.grasp.crops import TRAIN_CROPS, label_crops
from qsgm.grasp.source import CropSource
from qsgm.grasp.task import DETECTION_THRESHOLD
from qsgm.task import Array, Rows


@dataclass(frozen=True)
class Orientation:
    """How demonstrations lie as the untouched network sees them."""

    offset_rad: float  # of the first one
    strength: float  # 1: all its crops agree on it, 0: there is none (a round object)
    of_each_rad: tuple[float, ...]  # of every demonstration


@dataclass(frozen=True)
class GraspLabels:
    """Labels of all crops, aligned with the network's own idea of how the object lies."""

    labels: Array  # (N, 3): quality, and the encoded angle
    angle_rad: NDArray[np.float64]  # (N,) of the labels, the offset included
    addition: NDArray[np.uint8]  # (N,) of Addition: what was put on each crop
    orientation: Orientation
    encoding: AngleEncoding

    def scores(self, outputs: Array, rows: Rows) -> dict[str, float | None]:
        """Detection and angle error of outputs (B, 3) on the crops `rows`.

        `_plain`: over the crops that show the frame as it is, with nothing put on them.
        `told_apart`: share of the crops with another thing at their middle that are not taken for
        the object; None where there is no such crop.
        """
        addition = self.addition[rows]
        plain = addition == Addition.NOTHING
        thing = (addition == Addition.THING) & (self.labels[rows, 0] == 0)
        told = np.mean(outputs[thing, 0] <= DETECTION_THRESHOLD) if thing.any() else None
        everywhere, as_it_is = self._on(outputs, rows), self._on(outputs[plain], rows[plain])
        return {
            "detection_accuracy": everywhere[0],
            "angle_mae_deg": everywhere[1],
            "detection_accuracy_plain": as_it_is[0],
            "angle_mae_deg_plain": as_it_is[1],
            "told_apart": None if told is None else float(told),
        }

    def _on(self, outputs: Array, rows: Rows) -> tuple[float, float]:
        positive = self.labels[rows, 0] > 0
        detected = outputs[:, 0] > DETECTION_THRESHOLD
        angle = decode_angle(outputs[positive, 1], outputs[positive, 2], self.encoding)
        error = np.degrees(angle_error(angle, self.angle_rad[rows][positive]))
        return float(np.mean(detected == positive)), float(np.mean(error))


@dataclass(frozen=True)
class GraspLesson:
    """The crops of an object's demonstrations."""

    crops: CropSource
    encoding: AngleEncoding = "double"
    # Of each demonstration's object since the first one, where the patch says it.
    turns_rad: Sequence[float | None] = (0.0,)
    taught: int = TRAIN_CROPS

    def __len__(self) -> int:
        return len(self.crops)

    def cut(self, rows: Rows) -> NDArray[np.uint8]:
        """The crops `rows`: (B, 128, 128, 3) BGR."""
        return self.crops.cut(rows)

    def labelled(self, untouched: Array) -> GraspLabels:
        """Labels, shifted by how the demonstrations lie as the untouched network sees them."""
        orientation = self.orientation(untouched)
        offset = np.array(orientation.of_each_rad)[self.crops.shown]
        plan = self.crops.plan
        return GraspLabels(
            label_crops(plan, offset.astype(np.float32), self.encoding),
            plan.turn_rad + offset,
            self.crops.addition,
            orientation,
            self.encoding,
        )

    def orientation(self, outputs: Array) -> Orientation:
        """What the untouched network's outputs (N, 3) say of the demonstrations.

        Where the patch says how far the object is turned since the first one, the crops of both say
        together how they lie; the others' speak for themselves.
        """
        crops, turns = self.crops, self.turns_rad
        known = np.array([0.0 if turn is None else turn for turn in turns])
        alike = np.array([turn is not None for turn in turns])
        # In float32 arctan2's last bits are the processor's own.
        sine, cosine = outputs[:, 1].astype(np.float64), outputs[:, 2].astype(np.float64)
        seen = decode_angle(sine, cosine, self.encoding)
        lying = seen - crops.plan.turn_rad - known[crops.shown]
        # Held-out crops have no say in it.
        taught = (crops.plan.quality > 0) & (np.arange(len(crops)) < self.taught)
        offset, strength = mean_direction(lying[taught & alike[crops.shown]])
        of_each = [
            offset + known[number]
            if alike[number]
            else mean_direction(lying[taught & (crops.shown == number)])[0]
            for number in range(len(turns))
        ]
        return Orientation(offset, strength, tuple(of_each))
