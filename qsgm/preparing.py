"""One demonstration as the tuned layers see it: crops, features, labels, the untouched accuracy.

What all methods share is done once, so that they can be compared on the very same crops.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from qsgm.angles import angle_error, decode_angle, mean_direction
from qsgm.bundle import COMMAND, Bundle, head_file, trunk_file
from qsgm.crops import TRAIN_CROPS, CropPlan, cut_crops, label_crops, plan_crops
from qsgm.runtime import running
from qsgm.settings import Settings, run_blocks, trunk_precision
from qsgm.tuning import BATCH, Features
from qsgm.weights import to_step_layout

Array = NDArray[np.float32]
# (stage, how much of it is done, out of how much)
Watch = Callable[[str, int, int], None]
# Crops that are in memory at once. With more the frozen layers in float take much of it, and are no
# quicker.
SLICE = 10
STEPS_PER_EPOCH = -(-TRAIN_CROPS // BATCH)
DETECTION_THRESHOLD = 0.5


@dataclass(frozen=True)
class Accuracy:
    """On the validation crops."""

    detection_accuracy: float  # share of crops on the right side of 0.5
    angle_mae_deg: float  # modulo 180 degrees, over positives


@dataclass(frozen=True)
class Prepared:
    """One demonstration as the tuned layers see it."""

    bundle: Bundle
    settings: Settings
    features: Features  # (N, P, C), input of the first tuned layer
    labels: Array  # (N, 3)
    angle_rad: NDArray[np.float64]  # (N,) of the labels, the offset included
    offset_rad: float  # the demonstration's orientation as the untouched network sees it
    offset_strength: float  # 1: all crops agree on it, 0: there is none (a round object)
    start: dict[str, Array]  # weights and biases, in the step graphs' layout
    zero_shot: Accuracy
    seconds: dict[str, float]  # crops, features


def prepare(
    frame: NDArray[np.uint8], bundle: Bundle, settings: Settings, watch: Watch | None = None
) -> Prepared:
    """Crops, features, labels and what the untouched network makes of them.

    Of the settings only `layers`, `trunk`, `seed`, `center_px` and `threads` matter here; the
    others are checked.
    """
    if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
        raise ValueError(f"`frame` must be uint8 (H, W, 3), got {frame.dtype} {frame.shape}")
    bundle.check_blocks(run_blocks(settings))
    began = time.perf_counter()
    height, width = frame.shape[:2]
    center = settings.center_px or (width / 2, height / 2)
    plan = plan_crops((height, width), center, np.random.default_rng(settings.seed))
    seconds = {"crops": 0.0, "features": 0.0}
    features = see(frame, plan, bundle, settings, seconds, watch or ignore)
    start = in_step_layout(bundle.start_weights(settings.layers))
    outputs = answers(features, start, bundle, settings)
    seen = decode_angle(outputs[:, 1], outputs[:, 2], bundle.encoding)
    # Validation crops have no say in it.
    positive = np.flatnonzero(plan.quality[:TRAIN_CROPS] > 0)
    offset, strength = mean_direction(seen[positive] - plan.turn_rad[positive])
    labels = label_crops(plan, offset, bundle.encoding)
    angle = plan.turn_rad.astype(np.float64) + offset
    seconds["total"] = time.perf_counter() - began
    return Prepared(
        bundle,
        settings,
        features,
        labels,
        angle,
        offset,
        strength,
        start,
        accuracy_of(outputs[TRAIN_CROPS:], labels[TRAIN_CROPS:], angle[TRAIN_CROPS:], bundle),
        seconds,
    )


def see(
    frame: NDArray[np.uint8],
    plan: CropPlan,
    bundle: Bundle,
    settings: Settings,
    seconds: dict[str, float],
    watch: Watch,
) -> Features:
    """Features (N, P, C) of the planned crops, cut slice by slice: they never all exist."""
    name = trunk_file(trunk_precision(settings, bundle), settings.layers)
    session = bundle.session(name, settings.threads)
    features: Features | None = None
    for first in range(0, len(plan), SLICE):
        rows = slice(first, min(first + SLICE, len(plan)))
        with _adding_to(seconds, "crops"):
            crops = cut_crops(frame, plan[rows])
        with _adding_to(seconds, "features"):
            with running_graphs(bundle):
                some = session.run(["features"], {"crops": crops})[0]
            if features is None:
                features = np.empty((len(plan), *some.shape[1:]), some.dtype)
            features[rows] = some
        watch("crops", rows.stop, len(plan))
    assert features is not None, "a plan has at least one crop"
    return features


def answers(
    features: Features, weights: Mapping[str, Array], bundle: Bundle, settings: Settings
) -> Array:
    """Quality, sine and cosine (N, 3) that the tuned layers give with these weights."""
    session = bundle.session(head_file(settings.layers), settings.threads)
    slices = range(0, len(features), SLICE)
    with running_graphs(bundle):
        return np.concatenate(
            [
                session.run(["outputs"], {"features": features[i : i + SLICE], **weights})[0]
                for i in slices
            ]
        )


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
    rows = slice(TRAIN_CROPS, None)
    outputs = answers(prepared.features[rows], weights, prepared.bundle, settings)
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
def _adding_to(seconds: dict[str, float], stage: str) -> Iterator[None]:
    began = time.perf_counter()
    yield
    seconds[stage] += time.perf_counter() - began


def ignore(_stage: str, _done: int, _of: int) -> None:
    """Watch nothing."""
