"""An object as the tuned layers see it: crops, features, labels, the untouched accuracy.

What all methods share is done once, so that they can be compared on the very same crops.
"""

import time
from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from qsgm.bundle import COMMAND, Bundle, head_file, trunk_file
from qsgm.grasp.angles import angle_error, decode_angle, mean_direction
from qsgm.grasp.clutter import Addition
from qsgm.grasp.crops import TRAIN_CROPS, label_crops
from qsgm.grasp.others import Other, add_others
from qsgm.grasp.shown import Shown, shown
from qsgm.grasp.source import CropSource, Demonstration, crop_source
from qsgm.runtime import running
from qsgm.tune.loop import BATCH, Features
from qsgm.tune.settings import Settings, run_blocks, trunk_precision
from qsgm.weights import to_step_layout

Array = NDArray[np.float32]
Rows = NDArray[np.int64]
Frame = NDArray[np.uint8]
# One frame with the object at its centre, or some that show it anywhere.
Frames = Frame | Sequence[Frame | Demonstration]
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
    # The same over the crops that show the frame as it is, with nothing put on them.
    detection_accuracy_plain: float | None = None
    angle_mae_deg_plain: float | None = None
    # Share of the crops with another thing at their middle that are not taken for the object.
    told_apart: float | None = None


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
    """Made again whenever they are asked for: kept are the frames and the plan of the crops."""

    def __init__(
        self,
        crops: CropSource,
        bundle: Bundle,
        settings: Settings,
        seconds: MutableMapping[str, float],  # crops, features: what they take is added there
    ) -> None:
        name = trunk_file(trunk_precision(settings, bundle), settings.layers)
        self._crops, self._bundle, self._seconds = crops, bundle, seconds
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
                crops = self._crops.cut(rows[some])
            with _adding_to(self._seconds, "features"), running_graphs(self._bundle):
                features[some] = self._session.run(["features"], {"crops": crops})[0]
            if watch is not None:
                watch("crops", some.stop, len(rows))
        return features

    def batch(self, rows: Rows, labels: Array) -> tuple[Features, Array, Rows]:
        return self.of(rows), labels[rows], np.arange(len(rows))


@dataclass(frozen=True)
class Orientation:
    """How demonstrations lie as the untouched network sees them."""

    offset_rad: float  # of the first one
    strength: float  # 1: all its crops agree on it, 0: there is none (a round object)
    of_each_rad: tuple[float, ...]  # of every demonstration


@dataclass(frozen=True)
class Prepared:
    """An object as the tuned layers see it."""

    bundle: Bundle
    settings: Settings
    shown: Shown
    source: FeatureSource
    labels: Array  # (N, 3)
    angle_rad: NDArray[np.float64]  # (N,) of the labels, the offset included
    addition: NDArray[np.uint8]  # (N,) of Addition: what was put on each crop
    orientation: Orientation
    start: dict[str, Array]  # weights and biases, in the step graphs' layout
    zero_shot: Accuracy
    seconds: dict[str, float]  # crops, features, total
    others_sha256: tuple[str, ...] = ()  # of the things that it is to be told apart from

    @property
    def offset_rad(self) -> float:
        """The demonstration's orientation as the untouched network sees it."""
        return self.orientation.offset_rad

    @property
    def offset_strength(self) -> float:
        """How much its crops agree on that, 0 to 1."""
        return self.orientation.strength

    @property
    def features(self) -> Features:
        """All crops' (N, P, C), input of the first tuned layer; streamed ones are made for it."""
        features, _, _ = self.batch(np.arange(len(self.labels)))
        return features

    def batch(self, rows: Rows) -> tuple[Features, Array, Rows]:
        """Features (M, P, C), labels (M, 3), and where among them the crops `rows` are."""
        return self.source.batch(rows, self.labels)


def prepare(
    frames: Frames,
    bundle: Bundle,
    settings: Settings,
    watch: Watch | None = None,
    others: Sequence[Other] = (),
) -> Prepared:
    """Crops, features, labels and what the untouched network makes of them.

    Args:
        frames: one frame (H, W, 3) BGR with the object at its centre, or at the settings'; or
            several of the same object.
        bundle: whose network it is.
        settings: only `layers`, `trunk`, `seed`, `center_px`, `span_px`, `stream` and `threads`
            matter here; the others are checked.
        watch: told about progress.
        others: things to tell the object apart from, beside the bundle's.

    Raises:
        QsgmError: the object's window leaves the frame, the object fills it, or the bundle cannot
            do what the settings ask for.
    """
    demonstrations = as_demonstrations(frames, settings)
    bundle.check_blocks(run_blocks(settings))
    began = time.perf_counter()
    seen = shown(demonstrations, settings.span_px)
    things = add_others(bundle.distractors(), others, seen.scale)
    crops = crop_source(seen.demonstrations, things, np.random.default_rng(settings.seed))
    seconds = {"crops": 0.0, "features": 0.0}
    source = feature_source(crops, bundle, settings, seconds, watch or ignore)
    start = in_step_layout(bundle.start_weights(settings.layers))
    outputs = answers(source, np.arange(len(crops)), start, bundle, settings)
    orientation = orientation_of(outputs, crops, seen.turns_rad, bundle)
    offset = np.array(orientation.of_each_rad)[crops.shown]
    labels = label_crops(crops.plan, offset.astype(np.float32), bundle.encoding)
    angle = crops.plan.turn_rad + offset
    addition, held_out = crops.addition, slice(TRAIN_CROPS, None)
    zero_shot = accuracy_on(
        outputs[held_out], labels[held_out], angle[held_out], addition[held_out], bundle
    )
    # What is streamed later is part of other stages.
    seconds = seconds | {"total": time.perf_counter() - began}
    return Prepared(
        bundle,
        settings,
        seen,
        source,
        labels,
        angle,
        addition,
        orientation,
        start,
        zero_shot,
        seconds,
        tuple(other.sha256 for other in others),
    )


def as_demonstrations(frames: Frames, settings: Settings) -> list[Demonstration]:
    """Frames, each with where its object is: at the settings' centre, else at its own."""
    some = [frames] if isinstance(frames, np.ndarray) else list(frames)
    if not some:
        raise ValueError("`frames` must hold at least one frame")
    found = []
    for one in some:
        frame = one.frame if isinstance(one, Demonstration) else one
        if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
            raise ValueError(f"`frame` must be uint8 (H, W, 3), got {frame.dtype} {frame.shape}")
        center = settings.center_px or (frame.shape[1] / 2, frame.shape[0] / 2)
        found.append(one if isinstance(one, Demonstration) else Demonstration(frame, center))
    return found


def orientation_of(
    outputs: Array, crops: CropSource, turns_rad: Sequence[float | None], bundle: Bundle
) -> Orientation:
    """What the untouched network's outputs (N, 3) say of the demonstrations.

    Where the patch says how far the object is turned since the first one (`turns_rad`), the crops
    of both say together how they lie; the others' speak for themselves.
    """
    known = np.array([0.0 if turn is None else turn for turn in turns_rad])
    alike = np.array([turn is not None for turn in turns_rad])
    seen = decode_angle(outputs[:, 1], outputs[:, 2], bundle.encoding)
    lying = seen - crops.plan.turn_rad - known[crops.shown]
    # Validation crops have no say in it.
    taught = (crops.plan.quality > 0) & (np.arange(len(crops)) < TRAIN_CROPS)
    offset, strength = mean_direction(lying[taught & alike[crops.shown]])
    of_each = [
        offset + known[number]
        if alike[number]
        else mean_direction(lying[taught & (crops.shown == number)])[0]
        for number in range(len(turns_rad))
    ]
    return Orientation(offset, strength, tuple(of_each))


def feature_source(
    crops: CropSource,
    bundle: Bundle,
    settings: Settings,
    seconds: MutableMapping[str, float],
    watch: Watch,
) -> FeatureSource:
    """Features of the planned crops, kept or streamed as the settings say."""
    if settings.stream:
        return StreamedFeatures(crops, bundle, settings, seconds)
    return KeptFeatures(see(crops, bundle, settings, seconds, watch))


def see(
    crops: CropSource,
    bundle: Bundle,
    settings: Settings,
    seconds: MutableMapping[str, float],
    watch: Watch,
) -> Features:
    """Features (N, P, C) of all planned crops."""
    made = StreamedFeatures(crops, bundle, settings, seconds)
    return made.of(np.arange(len(crops)), watch)


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


def accuracy_on(
    outputs: Array,
    labels: Array,
    angle_rad: NDArray[np.float64],
    addition: NDArray[np.uint8],
    bundle: Bundle,
) -> Accuracy:
    """:func:`accuracy_of`, with and without the crops (N,) that something was put on."""
    whole = accuracy_of(outputs, labels, angle_rad, bundle)
    plain = addition == Addition.NOTHING
    as_it_is = accuracy_of(outputs[plain], labels[plain], angle_rad[plain], bundle)
    thing = (addition == Addition.THING) & (labels[:, 0] == 0)
    told = np.mean(outputs[thing, 0] <= DETECTION_THRESHOLD) if thing.any() else None
    return replace(
        whole,
        detection_accuracy_plain=as_it_is.detection_accuracy,
        angle_mae_deg_plain=as_it_is.angle_mae_deg,
        told_apart=None if told is None else float(told),
    )


def validate(prepared: Prepared, weights: Mapping[str, Array], settings: Settings) -> Accuracy:
    """Weights, in the step graphs' layout, on the crops that took no part in training."""
    rows = np.arange(TRAIN_CROPS, len(prepared.labels))
    outputs = answers(prepared.source, rows, weights, prepared.bundle, settings)
    known = prepared.labels[rows], prepared.angle_rad[rows], prepared.addition[rows]
    return accuracy_on(outputs, *known, prepared.bundle)


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
