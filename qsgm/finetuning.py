"""Fine-tune on one demonstration: crops, features of the frozen layers, feed-forward training.

    frame = read_frame(Path("object.png"))
    result = finetune(frame, load_bundle(Path("export")))
    result.save(Path("mug"), name="mug")

The stages stand alone: :func:`prepare` does what all methods share, :func:`train` one run of one
method on it, so that methods can be compared on the very same crops.
"""

import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from qsgm import defaults
from qsgm.angles import angle_error, decode_angle, mean_direction
from qsgm.blocks import Blocks, one_block, parse_blocks, single_layers, tuned_layers
from qsgm.bundle import (
    COMMAND,
    Bundle,
    Method,
    OptimizerName,
    Precision,
    Recipe,
    head_file,
    probe_file,
    step_file,
    trunk_file,
)
from qsgm.crops import TRAIN_CROPS, CropPlan, cut_crops, label_crops, plan_crops
from qsgm.drift import drift_warnings
from qsgm.errors import QsgmError
from qsgm.fidelity import PROBED, LayerFidelity, compare_probe, mean_over_run
from qsgm.recalibration import recalibrated
from qsgm.report import run_json
from qsgm.runtime import running
from qsgm.tuned import ObjectDescription, TunedObject, save_object
from qsgm.tuning import BATCH, Features, StepLoop, tune
from qsgm.weights import to_conv_layout, to_step_layout

Array = NDArray[np.float32]
# (stage, how much of it is done, out of how much)
Watch = Callable[[str, int, int], None]
# Constants of int8 SGMs: by layer, by initializer name.
Exchanged = Mapping[int, Mapping[str, NDArray[Any]]]
NOTHING_EXCHANGED: Exchanged = MappingProxyType({})

# Crops that are in memory at once. With more the frozen layers in float take much of it, and are no
# quicker.
SLICE = 10
STEPS_PER_EPOCH = -(-TRAIN_CROPS // BATCH)
DETECTION_THRESHOLD = 0.5
# Crops whose activations an int8 SGM is calibrated on anew, and how many at a time; of maps, whose
# crops have thousands of positions, the first slice has to do.
RECALIBRATION_CROPS, RECALIBRATION_SLICE = 400, 16
# What each layer leaves per crop: convolution and ReLU, and the pool's one position.
OUTPUTS_PER_CROP = {
    1: 8 * 2 * 62**2,
    2: 8 * 2 * 29**2,
    3: 16 * 2 * 13**2,
    4: 16 * (2 * 5**2 + 1),
    5: 16 * 2,
    6: 3,
}


@dataclass(frozen=True)
class Settings:
    """How to tune; what is None is up to the bundle."""

    method: Method = "sgm"
    precision: Precision = "int8"  # of the SGMs; backpropagation has one, float
    layers: int = defaults.LAYERS  # how many of the last ones
    blocks: str | None = None  # those layers in groups, such as 4,5-6; None: each on its own
    trunk: Precision | None = None  # of the frozen layers
    optimizer: OptimizerName | None = None
    epochs: int = defaults.EPOCHS
    recalibrate: bool = False  # the int8 SGMs, on this object's crops before the first step
    seed: int = 0
    center_px: tuple[float, float] | None = None  # of the object; None: the frame's centre
    threads: int = 1
    probe_every: int = defaults.PROBE_EVERY  # steps from one look at the gradients to the next


@dataclass(frozen=True)
class Accuracy:
    """On the validation crops."""

    detection_accuracy: float  # share of crops on the right side of 0.5
    angle_mae_deg: float  # modulo 180 degrees, over positives


@dataclass(frozen=True)
class Probe:
    """What the gradients were worth after so many steps (0: before the first one)."""

    step: int
    layers: dict[int, LayerFidelity]  # by SGM layer

    @property
    def epoch(self) -> float:
        """Passes over the crops that the steps make."""
        return self.step / STEPS_PER_EPOCH


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


@dataclass(frozen=True)
class FinetuneResult:
    """A tuned object and everything that was measured on the way."""

    prepared: Prepared
    settings: Settings
    recipe: Recipe
    weights: dict[str, Array]  # (Co, Ci, kh, kw) and biases (Co,)
    accuracy: Accuracy
    losses: tuple[float, ...]  # mean over each epoch
    probes: tuple[Probe, ...]
    seconds: dict[str, float]  # crops, features, tuning, probes, total
    warnings: tuple[str, ...] = field(default=())
    # by step (0: before the first), in the step graphs' layout
    kept: Mapping[int, dict[str, Array]] = field(default_factory=dict)

    @property
    def steps(self) -> int:
        """How many there were."""
        return self.settings.epochs * STEPS_PER_EPOCH

    @property
    def zero_shot(self) -> Accuracy:
        """The same crops, by the untouched network."""
        return self.prepared.zero_shot

    @property
    def trunk(self) -> Precision:
        """Of the frozen layers."""
        return trunk_precision(self.prepared.settings, self.prepared.bundle)

    @property
    def fidelity(self) -> dict[int, LayerFidelity]:
        """By SGM layer, the mean over the run."""
        if not self.probes:
            return {}
        layers = self.probes[0].layers
        return {k: mean_over_run([probe.layers[k] for probe in self.probes]) for k in layers}

    @property
    def blocks(self) -> Blocks:
        """What was trained, block by block."""
        return run_blocks(self.settings)

    @property
    def peak_activation_bytes(self) -> dict[str, int]:
        """Layer outputs that have to be alive at once; see :func:`peak_activation_bytes`."""
        return peak_activation_bytes(sgm_blocks(self.settings))

    def network(self) -> bytes:
        """The tuned network as an ONNX file: a frame in, its heatmap out."""
        return self.prepared.bundle.network_with(self.weights)

    def save(self, folder: Path, name: str) -> None:
        """Write the tuned object for `qsgm predict`; it appears complete or not at all.

        Args:
            folder: absent, empty or an earlier tuned object.
            name: what the object is called.

        Raises:
            QsgmError: the folder cannot be written, or holds something else.
        """
        report = run_json(self, name, folder)
        save_object(folder, self._description(name), self.network(), report)

    def tuned_object(self, name: str = "object") -> TunedObject:
        """The tuned object without a detour over the disk."""
        return TunedObject(self._description(name), self.network(), self.settings.threads)

    def _description(self, name: str) -> ObjectDescription:
        return ObjectDescription(name, self.prepared.bundle.encoding, self.prepared.offset_rad)


def sgm_blocks(settings: Settings) -> Blocks:
    """The blocks of a run with SGMs: what its steps are, or what backpropagation is compared with.

    Raises:
        QsgmError: the settings' blocks are none, or those of another number of layers.
    """
    if settings.blocks is None:
        return single_layers(settings.layers)
    blocks = parse_blocks(settings.blocks)
    if len(blocks.layers) != settings.layers:
        raise QsgmError(
            f"the blocks {blocks} are the last {len(blocks.layers)} layers, the settings say "
            f"{settings.layers}: give both the same"
        )
    return blocks


def run_blocks(settings: Settings) -> Blocks:
    """The blocks that are really trained.

    Raises:
        QsgmError: as :func:`sgm_blocks`, or the blocks do not go with the method.
    """
    blocks, whole = sgm_blocks(settings), one_block(settings.layers)
    if settings.method == "sgm":
        if blocks == whole and settings.layers > 1:
            raise QsgmError(f"the blocks {blocks} leave no place for an SGM: pass --method bp")
        return blocks
    if settings.blocks is not None and blocks != whole:
        raise QsgmError(
            f"backpropagation trains all layers as one block, {whole}, not as {blocks}: leave "
            "--blocks out, or --method bp"
        )
    return whole


def finetune(
    frame: NDArray[np.uint8],
    bundle: Bundle,
    settings: Settings | None = None,
    watch: Watch | None = None,
) -> FinetuneResult:
    """Tune the bundle's network to the object in a demonstration frame (H, W, 3) BGR.

    Raises:
        QsgmError: the object's window leaves the frame, the bundle cannot do what the settings
            ask for, or training diverged.
    """
    settings = settings or Settings()
    return train(prepare(frame, bundle, settings, watch), settings, watch)


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
    features = see(frame, plan, bundle, settings, seconds, watch or _ignore)
    start = _in_step_layout(bundle.start_weights(settings.layers))
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


def trunk_precision(settings: Settings, bundle: Bundle) -> Precision:
    """Of the frozen layers: the settings' or, where they have none, the bundle's."""
    return settings.trunk or bundle.trunk


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


def train(
    prepared: Prepared,
    settings: Settings,
    watch: Watch | None = None,
    *,
    probe: bool = True,
    recipe: Recipe | None = None,
    keep: Collection[int] = (),
    exchanged: Exchanged = NOTHING_EXCHANGED,
) -> FinetuneResult:
    """One run of one method on a prepared demonstration; what was prepared stays as it is.

    Args:
        prepared: as :func:`prepare` returned it.
        settings: may differ from those it was prepared with in `method`, `precision`, `blocks`,
            `optimizer`, `epochs`, `recalibrate`, `threads` and `probe_every`.
        watch: told about every epoch.
        probe: whether to measure the gradients' fidelity.
        recipe: optimizer and rates; None: the bundle's for these settings.
        keep: steps after which the weights are kept (0: before the first).
        exchanged: constants of int8 SGMs in the place of the bundle's; where the settings say
            `recalibrate` they are found here instead.

    Raises:
        QsgmError: training diverged, the bundle lacks the method, or there is nothing to
            recalibrate.
    """
    began = time.perf_counter()
    bundle, layers = prepared.bundle, settings.layers
    if layers != prepared.settings.layers:
        raise ValueError(f"prepared for {prepared.settings.layers} layers, not for {layers}")
    if settings.method == "bp":
        settings = replace(settings, precision="float")
    blocks = run_blocks(settings)
    bundle.check_blocks(blocks)
    recipe = recipe or bundle.recipe(settings.method, layers, settings.optimizer, blocks)
    extra = {}
    if settings.recalibrate:
        exchanged = recalibrate(prepared, settings)
        extra["recalibration"] = time.perf_counter() - began
    prober = _Prober(prepared, settings, probe, exchanged)
    loop = _GuardedLoop(prepared, settings, recipe, keep, prober, exchanged)
    losses, tuning = _run_epochs(loop, prober, settings, watch or _ignore)
    weights = loop.weights()
    accuracy = validate(prepared, weights, settings)
    seconds = prepared.seconds | extra | {"tuning": tuning, "probes": prober.seconds}
    seconds["total"] = prepared.seconds["total"] + time.perf_counter() - began
    result = FinetuneResult(
        prepared,
        settings,
        recipe,
        _in_conv_layout(weights, bundle.start_weights(layers)),
        accuracy,
        tuple(losses),
        tuple(prober.probes),
        seconds,
        kept=loop.kept,
    )
    if settings.precision == "float":
        return result
    advice = "compare with --float" if settings.recalibrate else "tune it with --recalibrate"
    return replace(result, warnings=drift_warnings(result.fidelity, advice))


def _run_epochs(
    loop: "_GuardedLoop", prober: "_Prober", settings: Settings, watch: Watch
) -> tuple[list[float], float]:
    """Mean loss of every epoch, and the seconds that training took without the probes."""
    losses: list[float] = []

    def after_epoch(epoch: int, loss: float) -> None:
        losses.append(loss)
        loop.finite_weights()
        watch("tuning", epoch, settings.epochs)

    began, probing = time.perf_counter(), prober.seconds
    # Methods with the same seed see the same batches in the same order.
    tune(loop, TRAIN_CROPS, settings.epochs, np.random.default_rng([settings.seed, 1]), after_epoch)
    return losses, time.perf_counter() - began - (prober.seconds - probing)


def validate(prepared: Prepared, weights: Mapping[str, Array], settings: Settings) -> Accuracy:
    """Weights, in the step graphs' layout, on the crops that took no part in training."""
    rows = slice(TRAIN_CROPS, None)
    outputs = answers(prepared.features[rows], weights, prepared.bundle, settings)
    return accuracy_of(outputs, prepared.labels[rows], prepared.angle_rad[rows], prepared.bundle)


def recalibrate(prepared: Prepared, settings: Settings) -> Exchanged:
    """Constants of this run's int8 SGMs for this object; see :mod:`qsgm.recalibration`.

    Raises:
        QsgmError: the run has no int8 SGM, or the bundle no probe to see activations with.
    """
    if not (settings.precision == "int8" and run_blocks(settings).sgm_layers):
        raise QsgmError(
            "there is nothing to recalibrate: the run has no int8 SGM; leave --recalibrate out, or "
            "tune two layers or more with --method sgm and --int8"
        )
    return recalibrated(prepared.bundle, activations_before(prepared, settings))


def activations_before(prepared: Prepared, settings: Settings) -> dict[int, Array]:
    """What the layers in front of SGMs give on some training crops before any step, (N, P, C).

    Of maps a few crops do, each has thousands of positions; in memory are a few crops at a time.
    """
    session = open_probe(prepared, settings)
    found: dict[int, list[Array]] = {}
    for first in range(0, RECALIBRATION_CROPS, RECALIBRATION_SLICE):
        rows = np.arange(first, first + RECALIBRATION_SLICE)
        some = activations_of(session, prepared, settings, prepared.start, rows)
        for layer, activation in some.items():
            if first == 0 or activation.shape[1] == 1:
                found.setdefault(layer, []).append(activation)
    return {layer: np.concatenate(slices) for layer, slices in found.items()}


def open_probe(
    prepared: Prepared, settings: Settings, exchanged: Exchanged = NOTHING_EXCHANGED
) -> ort.InferenceSession:
    """A session of the probe graph. Raises QsgmError where the bundle has none."""
    bundle, name = prepared.bundle, probe_file(settings.layers)
    if name not in bundle.manifest["files"]:
        raise QsgmError(
            f"the bundle {bundle.folder} has no {name}, by which SGMs are looked at; export it "
            f"again with `{COMMAND}`"
        )
    constants = constants_of(exchanged, tuned_layers(settings.layers))
    return bundle.session(name, settings.threads, constants)


def activations_of(
    session: ort.InferenceSession,  # of the probe graph
    prepared: Prepared,
    settings: Settings,
    weights: Mapping[str, Array],
    rows: NDArray[np.int64],
) -> dict[int, Array]:
    """What the layers in front of SGMs give on the crops `rows` with these weights, (B, P, C)."""
    layers = sgm_blocks(settings).sgm_layers
    feeds = {"features": prepared.features, "labels": prepared.labels, "rows": rows, **weights}
    names = [f"activation{layer}" for layer in layers]
    with running_graphs(prepared.bundle):
        values = session.run(names, feeds, only_what_is_asked())
    return dict(zip(layers, values, strict=True))


def constants_of(exchanged: Exchanged, layers: Collection[int]) -> dict[str, NDArray[Any]]:
    """Those of the SGMs behind `layers`, by initializer name."""
    return {name: array for layer in layers for name, array in exchanged.get(layer, {}).items()}


def only_what_is_asked() -> ort.RunOptions:
    """Nothing is computed that the outputs asked for do not need."""
    options = ort.RunOptions()
    options.only_execute_path_to_fetches = True
    return options


def running_graphs(bundle: Bundle) -> AbstractContextManager[None]:
    """Around every run of a bundle's graph: they are checked when loaded, not for what they do."""
    return running(f"the bundle {bundle.folder}", f"export it again with `{COMMAND}`")


def peak_activation_bytes(blocks: Blocks, batch: int = BATCH) -> dict[str, int]:
    """Bytes of layer outputs that have to be alive at once while these layers are trained.

    Counted in float32: a layer's convolution, ReLU and pool (its batchnorm is folded here), which
    is how the paper's Table 3 counts layers 4 and 5; of layers 1 to 3 it counts one tensor.
    Backpropagation keeps those of all layers for the way back. With SGMs a block is done before
    the next one runs, so it is the largest block's. Windows, weights and features are not counted,
    both methods need them; nor is what SGMs and gradients take on the way.
    """
    outputs = [sum(4 * batch * OUTPUTS_PER_CROP[k] for k in block) for block in blocks.groups]
    return {"sgm": max(outputs), "backprop": sum(outputs)}


class _GuardedLoop(StepLoop):
    """Stops at the first step that leaves the realm of numbers; keeps and probes on the way."""

    def __init__(
        self,
        prepared: Prepared,
        settings: Settings,
        recipe: Recipe,
        keep: Collection[int],
        prober: "_Prober",
        exchanged: Exchanged,
    ) -> None:
        bundle, blocks = prepared.bundle, run_blocks(settings)
        name = step_file(settings.precision, recipe.optimizer, blocks)
        int8_layers = blocks.sgm_layers if settings.precision == "int8" else ()
        session = bundle.session(name, settings.threads, constants_of(exchanged, int8_layers))
        steps = settings.epochs * STEPS_PER_EPOCH
        rates = dict(zip(blocks.layers, recipe.rates_over(steps), strict=True))
        self.steps = 0
        self._bundle = bundle
        with running_graphs(bundle):
            super().__init__(session, prepared.features, prepared.labels, prepared.start, rates)
        self._keep, self._prober = keep, prober
        self.kept: dict[int, dict[str, Array]] = {}
        self._look()

    def step(self, rows: NDArray[np.int64], factor: float = 1.0) -> float:
        with running_graphs(self._bundle):
            loss = super().step(rows, factor)
        self.steps += 1
        self.refuse_unless_finite(bool(np.isfinite(loss)), "the loss")
        self._look()
        return loss

    def finite_weights(self) -> dict[str, Array]:
        weights = self.weights()
        self.refuse_unless_finite(all(np.isfinite(w).all() for w in weights.values()), "a weight")
        return weights

    def refuse_unless_finite(self, finite: bool, what: str) -> None:
        if not finite:
            raise QsgmError(
                f"tuning diverged: {what} is not finite at step {self.steps}; nothing was written. "
                f"Try another --method or --optimizer, or a frame with the object at its centre"
            )

    def _look(self) -> None:
        if self.steps in self._keep:
            self.kept[self.steps] = self.weights()
        if self._prober.wants(self.steps):
            self._prober(self.steps, self.finite_weights())


class _Prober:
    """Compares gradients on one random training batch at a time and keeps what it finds."""

    def __init__(
        self, prepared: Prepared, settings: Settings, wanted: bool, exchanged: Exchanged
    ) -> None:
        if settings.probe_every < 1:
            raise ValueError(f"`probe_every` must be 1 step or more, got {settings.probe_every}")
        began = time.perf_counter()
        self.probes: list[Probe] = []
        self._layers = sgm_blocks(settings).sgm_layers
        self._names = [f"{kind}{k}" for k in self._layers for kind in PROBED]
        self._every = settings.probe_every
        self._rng = np.random.default_rng([settings.seed, 2])
        self._session = None
        self._bundle = prepared.bundle
        name = probe_file(settings.layers)
        if wanted and self._layers and name in prepared.bundle.manifest["files"]:
            self._session = open_probe(prepared, settings, exchanged)
            self._refuse_unless_complete(name, self._session)
        self._data = {"features": prepared.features, "labels": prepared.labels}
        self.seconds = time.perf_counter() - began

    def wants(self, step: int) -> bool:
        return self._session is not None and step % self._every == 0

    def __call__(self, step: int, weights: Mapping[str, Array]) -> None:
        assert self._session is not None, "nobody wants to probe"
        began = time.perf_counter()
        rows = self._rng.choice(TRAIN_CROPS, BATCH, replace=False)
        feeds = {**self._data, "rows": rows, **weights}
        with running_graphs(self._bundle):
            values = self._session.run(self._names, feeds, only_what_is_asked())
        outputs = dict(zip(self._names, values, strict=True))
        self.probes.append(Probe(step, compare_probe(outputs, self._layers)))
        self.seconds += time.perf_counter() - began

    def _refuse_unless_complete(self, name: str, session: ort.InferenceSession) -> None:
        there = {output.name for output in session.get_outputs()}
        missing = [wanted for wanted in self._names if wanted not in there]
        if missing:
            raise QsgmError(
                f"{name} of the bundle {self._bundle.folder} has no output {missing[0]}: another "
                f"version of qsgm wrote it; export it again with `{COMMAND}`"
            )


def _in_step_layout(weights: Mapping[str, Array]) -> dict[str, Array]:
    return {
        name: to_step_layout(value) if value.ndim > 1 else value for name, value in weights.items()
    }


def _in_conv_layout(weights: Mapping[str, Array], like: Mapping[str, Array]) -> dict[str, Array]:
    return {
        name: to_conv_layout(weights[name], value.shape[-1]) if value.ndim > 1 else weights[name]
        for name, value in like.items()
    }


@contextmanager
def _adding_to(seconds: dict[str, float], stage: str) -> Iterator[None]:
    began = time.perf_counter()
    yield
    seconds[stage] += time.perf_counter() - began


def _ignore(_stage: str, _done: int, _of: int) -> None:
    """Watch nothing."""
