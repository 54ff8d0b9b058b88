"""Fine-tune on a demonstration: crops, features of the frozen layers, feed-forward training.

    frame = read_frame(Path("object.png"))
    result = finetune(frame, load_bundle(Path("export")))
    result.save(Path("mug"), name="mug")

The stages stand alone: :func:`qsgm.tune.prepare.prepare` does what all methods share, :func:`train`
one run of one method on it.
"""

import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from qsgm import __version__
from qsgm.blocks import Blocks, one_block
from qsgm.bundle import Bundle, Precision, Recipe, step_file
from qsgm.errors import QsgmError
from qsgm.fidelity import LayerFidelity, mean_over_run
from qsgm.grasp.crops import TRAIN_CROPS
from qsgm.grasp.likeness import likeness_of
from qsgm.grasp.others import Other
from qsgm.grasp.tuned import ObjectDescription, TunedObject, save_object
from qsgm.grasp.verdict import Verdict, verdict_on
from qsgm.runtime import run_options
from qsgm.tune.drift import drift_warnings
from qsgm.tune.loop import StepLoop, tune
from qsgm.tune.prepare import (
    STEPS_PER_EPOCH,
    Accuracy,
    Array,
    Frames,
    Prepared,
    Watch,
    ignore,
    prepare,
    running_graphs,
    validate,
)
from qsgm.tune.probe import NOTHING_EXCHANGED, Exchanged, Probe, Prober, constants_of, recalibrate
from qsgm.tune.report import run_json
from qsgm.tune.settings import (
    Settings,
    run_blocks,
    sgm_blocks,
    takes_much_memory,
    trunk_precision,
)
from qsgm.weights import to_conv_layout


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
    # crops, features, tuning, probes, total; what is streamed counts where it is asked for
    seconds: dict[str, float]
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
    def peak_activation_bytes(self) -> dict[str, int | None]:
        """Of a step, with SGMs and by backpropagation; see :func:`peak_activation_bytes`."""
        settings = self.settings
        return peak_activation_bytes(self.prepared.bundle, settings.precision, sgm_blocks(settings))

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

    @cached_property
    def verdict(self) -> Verdict:
        """Whether the object will be found and told apart."""
        prepared = self.prepared
        like = likeness_of(prepared.shown.patches[0])
        trained = self.settings.epochs > 0
        strength = prepared.offset_strength
        return verdict_on(self.accuracy, self.zero_shot, strength, like, trained=trained)

    def _description(self, name: str) -> ObjectDescription:
        prepared = self.prepared
        return ObjectDescription(
            name,
            prepared.bundle.encoding,
            prepared.offset_rad,
            prepared.shown.scale,
            prepared.shown.views(prepared.orientation.of_each_rad),
            prepared.bundle.decision(),
            self._made(),
        )

    def _made(self) -> dict[str, Any]:
        """From what, by what: with the same of all this the same object comes out."""
        return {
            "qsgm": __version__,
            "onnxruntime": ort.__version__,
            "opencv": cv2.__version__,
            "numpy": np.__version__,
            "bundle_sha256": self.prepared.bundle.sha256(),
            "seed": self.prepared.settings.seed,
            "frames_sha256": list(self.prepared.shown.sha256),
            "others_sha256": list(self.prepared.others_sha256),
        }


def finetune(
    frames: Frames,
    bundle: Bundle,
    settings: Settings | None = None,
    watch: Watch | None = None,
    others: Sequence[Other] = (),
) -> FinetuneResult:
    """Tune the bundle's network to an object.

    Args:
        frames: a demonstration frame (H, W, 3) BGR, or several of the same object, of which the
            first says what angle 0 is.
        bundle: whose network is tuned.
        settings: how.
        watch: told about progress.
        others: things to tell the object apart from.

    Raises:
        QsgmError: the object's window leaves the frame, the bundle cannot do what the settings
            ask for, or training diverged.
    """
    settings = settings or Settings()
    return train(prepare(frames, bundle, settings, watch, others), settings, watch)


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
        prepared: as :func:`qsgm.tune.prepare.prepare` returned it.
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
    prober = Prober(prepared, settings, probe, exchanged)
    loop = _GuardedLoop(prepared, settings, recipe, keep, prober, exchanged)
    losses, tuning = _run_epochs(loop, prober, settings, watch or ignore)
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
    loop: "_GuardedLoop", prober: "Prober", settings: Settings, watch: Watch
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


def peak_activation_bytes(
    bundle: Bundle, precision: Precision, blocks: Blocks
) -> dict[str, int | None]:
    """Bytes of activations alive at once in a step of 32 crops, with SGMs and by backpropagation.

    Reckoned from the graphs when they were exported (:mod:`qsgm.train.liveness`): weights, states,
    inputs and outputs do not count. None: the bundle does not say.
    """
    whole = one_block(len(blocks.layers))
    recipes = bundle.manifest["recipes"]
    names = {
        "sgm": step_file(precision, recipes["sgm"]["optimizer"], blocks),
        "backprop": step_file("float", recipes["bp"]["optimizer"], whole),
    }
    return {method: bundle.peak_activation_bytes(name) for method, name in names.items()}


class _GuardedLoop(StepLoop):
    """Stops at the first step that leaves the realm of numbers; keeps and probes on the way."""

    def __init__(
        self,
        prepared: Prepared,
        settings: Settings,
        recipe: Recipe,
        keep: Collection[int],
        prober: "Prober",
        exchanged: Exchanged,
    ) -> None:
        bundle, blocks = prepared.bundle, run_blocks(settings)
        name = step_file(settings.precision, recipe.optimizer, blocks)
        int8_layers = blocks.sgm_layers if settings.precision == "int8" else ()
        session = bundle.session(name, settings.threads, constants_of(exchanged, int8_layers))
        # A probe takes as much as a step: neither keeps its memory while the other runs.
        self._before_probe = run_options(give_memory_back=takes_much_memory(settings))
        steps = settings.epochs * STEPS_PER_EPOCH
        rates = dict(zip(blocks.layers, recipe.rates_over(steps), strict=True))
        self.steps = 0
        self._bundle, self._batch = bundle, prepared.batch
        features, labels, _ = prepared.batch(np.arange(0))
        with running_graphs(bundle):
            super().__init__(session, features, labels, prepared.start, rates)
        self._keep, self._prober = keep, prober
        self.kept: dict[int, dict[str, Array]] = {}
        self._look()

    def step(
        self,
        rows: NDArray[np.int64],
        factor: float = 1.0,
        options: ort.RunOptions | None = None,
    ) -> float:
        features, labels, among = self._batch(rows)
        if self._prober.wants(self.steps + 1):
            options = self._before_probe
        with running_graphs(self._bundle):
            self.put(features, labels)
            loss = super().step(among, factor, options)
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


def _in_conv_layout(weights: Mapping[str, Array], like: Mapping[str, Array]) -> dict[str, Array]:
    return {
        name: to_conv_layout(weights[name], value.shape[-1]) if value.ndim > 1 else weights[name]
        for name, value in like.items()
    }
