"""One demonstration as the tuned layers see it: crops, features, labels, the untouched accuracy.

What all methods share is done once, so that they can be compared on the very same crops.
"""

import time
from collections.abc import Callable, Iterator, Mapping, MutableMapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from qsgm.angles import angle_error, decode_angle, mean_direction
from qsgm.bundle import COMMAND, Bundle, head_file, trunk_file
from qsgm.crops import (
    TRAIN_CROPS,
    CropPlan,
    cut_widened,
    label_crops,
    plan_crops,
    widened,
)
from qsgm.runtime import running
from qsgm.settings import Settings, run_blocks, trunk_precision
from qsgm.tuning import BATCH, Features
from qsgm.weights import to_step_layout

Array = NDArray[np.float32]
Rows = NDArray[np.int64]
# (stage, how much of it is done, out of how much)
Watch = Callable[[str, int, int], None]
# Crops that are in memory at once. With more the frozen layers in float take much of it, and are no
# quicker. Batches and both sets of crops are whole numbers of slices: whatever a graph makes of a
# slice's size, a crop's features are the same in all of them.
SLICE = 8
STEPS_PER_EPOCH = -(-TRAIN_CROPS // BATCH)
DETECTION_THRESHOLD = 0.5


@dataclass(frozen=True)
class Accuracy:
    """On the validation crops."""

    detection_accuracy: float  # share of crops on the right side of 0.5
    angle_mae_deg: float  # modulo 180 degrees, over positives


class FeatureSource(Protocol):
    """Where the input of the first tuned layer comes from."""

    def of(self, rows: Rows) -> Features:
        """Features (B, P, C) of the crops `rows`."""

    def batch(self, rows: Rows, labels: Array) -> tuple[Features, Array, Rows]:
        """Features (M, P, C), labels (M, 3), and where among them the crops `rows` are.

        `labels` (N, 3) are all crops'.
        """


@dataclass(frozen=True)
class KeptFeatures:
    """Made once, for all crops."""

    features: Features  # (N, P, C)

    def of(self, rows: Rows) -> Features:
        return self.features[rows]

    def batch(self, rows: Rows, labels: Array) -> tuple[Features, Array, Rows]:
        return self.features, labels, rows


class StreamedFeatures:
    """Made again whenever they are asked for: kept are the frame and the plan of the crops."""

    def __init__(
        self,
        frame: NDArray[np.uint8],  # (H, W, 3)
        plan: CropPlan,
        bundle: Bundle,
        settings: Settings,
        seconds: MutableMapping[str, float],  # crops, features: what they take is added there
    ) -> None:
        name = trunk_file(trunk_precision(settings, bundle), settings.layers)
        self._frame, self._plan, self._bundle, self._seconds = widened(frame), plan, bundle, seconds
        self._session = bundle.session(name, settings.threads)
        (output,) = self._session.get_outputs()
        self._shape = tuple(output.shape[1:])
        self._dtype = np.dtype(np.uint8 if "uint8" in output.type else np.float32)

    def of(self, rows: Rows, watch: Watch | None = None) -> Features:
        """Features (B, P, C) of the crops `rows`, cut slice by slice: they never all exist."""
        features = np.empty((len(rows), *self._shape), self._dtype)
        for first in range(0, len(rows), SLICE):
            some = slice(first, min(first + SLICE, len(rows)))
            with _adding_to(self._seconds, "crops"):
                crops = cut_widened(self._frame, self._plan[rows[some]])
            with _adding_to(self._seconds, "features"), running_graphs(self._bundle):
                features[some] = self._session.run(["features"], {"crops": crops})[0]
            if watch is not None:
                watch("crops", some.stop, len(rows))
        return features

    def batch(self, rows: Rows, labels: Array) -> tuple[Features, Array, Rows]:
        return self.of(rows), labels[rows], np.arange(len(rows))


@dataclass(frozen=True)
class Prepared:
    """One demonstration as the tuned layers see it."""

    bundle: Bundle
    settings: Settings
    source: FeatureSource
    labels: Array  # (N, 3)
    angle_rad: NDArray[np.float64]  # (N,) of the labels, the offset included
    offset_rad: float  # the demonstration's orientation as the untouched network sees it
    offset_strength: float  # 1: all crops agree on it, 0: there is none (a round object)
    start: dict[str, Array]  # weights and biases, in the step graphs' layout
    zero_shot: Accuracy
    seconds: dict[str, float]  # crops, features, total

    @property
    def features(self) -> Features:
        """All crops' (N, P, C), input of the first tuned layer; streamed ones are made for it."""
        features, _, _ = self.batch(np.arange(len(self.labels)))
        return features

    def batch(self, rows: Rows) -> tuple[Features, Array, Rows]:
        """Features (M, P, C), labels (M, 3), and where among them the crops `rows` are."""
        return self.source.batch(rows, self.labels)


def prepare(
    frame: NDArray[np.uint8], bundle: Bundle, settings: Settings, watch: Watch | None = None
) -> Prepared:
    """Crops, features, labels and what the untouched network makes of them.

    Of the settings only `layers`, `trunk`, `seed`, `center_px`, `stream` and `threads` matter here;
    the others are checked.
    """
    if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
        raise ValueError(f"`frame` must be uint8 (H, W, 3), got {frame.dtype} {frame.shape}")
    bundle.check_blocks(run_blocks(settings))
    began = time.perf_counter()
    height, width = frame.shape[:2]
    center = settings.center_px or (width / 2, height / 2)
    plan = plan_crops((height, width), center, np.random.default_rng(settings.seed))
    seconds = {"crops": 0.0, "features": 0.0}
    source = feature_source(frame, plan, bundle, settings, seconds, watch or ignore)
    start = in_step_layout(bundle.start_weights(settings.layers))
    outputs = answers(source, np.arange(len(plan)), start, bundle, settings)
    seen = decode_angle(outputs[:, 1], outputs[:, 2], bundle.encoding)
    # Validation crops have no say in it.
    positive = np.flatnonzero(plan.quality[:TRAIN_CROPS] > 0)
    offset, strength = mean_direction(seen[positive] - plan.turn_rad[positive])
    labels = label_crops(plan, offset, bundle.encoding)
    angle = plan.turn_rad.astype(np.float64) + offset
    return Prepared(
        bundle,
        settings,
        source,
        labels,
        angle,
        offset,
        strength,
        start,
        accuracy_of(outputs[TRAIN_CROPS:], labels[TRAIN_CROPS:], angle[TRAIN_CROPS:], bundle),
        # What is streamed later is part of other stages.
        seconds | {"total": time.perf_counter() - began},
    )


def feature_source(
    frame: NDArray[np.uint8],
    plan: CropPlan,
    bundle: Bundle,
    settings: Settings,
    seconds: MutableMapping[str, float],
    watch: Watch,
) -> FeatureSource:
    """Features of the planned crops, kept or streamed as the settings say."""
    if settings.stream:
        return StreamedFeatures(frame, plan, bundle, settings, seconds)
    return KeptFeatures(see(frame, plan, bundle, settings, seconds, watch))


def see(
    frame: NDArray[np.uint8],
    plan: CropPlan,
    bundle: Bundle,
    settings: Settings,
    seconds: MutableMapping[str, float],
    watch: Watch,
) -> Features:
    """Features (N, P, C) of all planned crops."""
    made = StreamedFeatures(frame, plan, bundle, settings, seconds)
    return made.of(np.arange(len(plan)), watch)


def answers(
    source: FeatureSource,
    rows: Rows,
    weights: Mapping[str, Array],
    bundle: Bundle,
    settings: Settings,
) -> Array:
    """Quality, sine and cosine (B, 3) that the tuned layers give for the crops `rows`."""
    session = bundle.session(head_file(settings.layers), settings.threads)
    outputs = []
    for first in range(0, len(rows), SLICE):
        features = source.of(rows[first : first + SLICE])
        with running_graphs(bundle):
            outputs += session.run(["outputs"], {"features": features, **weights})
    return np.concatenate(outputs)


def accuracy_of(
    outputs: Array, labels: Array, angle_rad: NDArray[np.float64], bundle: Bundle
) -> Accuracy:
    """Outputs (N, 3) against labels (N, 3) and the angles (N,) that the labels encode."""
    positive = labels[:, 0] > 0
    detected = outputs[:, 0] > DETECTION_THRESHOLD
    angle = decode_angle(outputs[positive, 1], outputs[positive, 2], bundle.encoding)
    error = np.degrees(angle_error(angle, angle_rad[positive]))
    return Accuracy(float(np.mean(detected == positive)), float(np.mean(error)))


def validate(prepared: Prepared, weights: Mapping[str, Array], settings: Settings) -> Accuracy:
    """Weights, in the step graphs' layout, on the crops that took no part in training."""
    rows = np.arange(TRAIN_CROPS, len(prepared.labels))
    outputs = answers(prepared.source, rows, weights, prepared.bundle, settings)
    return accuracy_of(outputs, prepared.labels[rows], prepared.angle_rad[rows], prepared.bundle)


def running_graphs(bundle: Bundle) -> AbstractContextManager[None]:
    """Around every run of a bundle's graph: they are checked when loaded, not for what they do."""
    return running(f"the bundle {bundle.folder}", f"export it again with `{COMMAND}`")


def in_step_layout(weights: Mapping[str, Array]) -> dict[str, Array]:
    """Weights (Co, Ci, kh, kw) as step graphs have them; biases (Co,) as they are."""
    return {
        name: to_step_layout(value) if value.ndim > 1 else value for name, value in weights.items()
    }


@contextmanager
def _adding_to(seconds: MutableMapping[str, float], stage: str) -> Iterator[None]:
    began = time.perf_counter()
    yield
    seconds[stage] += time.perf_counter() - began


def ignore(_stage: str, _done: int, _of: int) -> None:
    """Watch nothing."""
