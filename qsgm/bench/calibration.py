"""What a calibration set is worth off its own kind: sets, calibrators and bits, judged elsewhere.

Every set is taken from far to near: its ranges are taken along float fine-tuning runs on its own
frames, its int8 SGMs then tune other frames, and their gradients and results are compared with the
float SGMs' on the same crops. Nothing is exported: an SGM's constants are exchanged in the bundle's
own graphs.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.text import Text

from qsgm.bench.frames import MANIFEST, BenchFrame, list_frames
from qsgm.bundle import Bundle
from qsgm.errors import QsgmError
from qsgm.grasp.teach import prepare_object
from qsgm.manifest import PRECISIONS
from qsgm.progress import Progress
from qsgm.schedule import steps_per_epoch
from qsgm.sgm.float import float_trace
from qsgm.sgm.int8 import (
    ACTIVATION_BITS,
    WEIGHT_BITS,
    ActivationBits,
    SgmRanges,
    WeightBits,
    constants,
    constants_of_two_planes,
    quantize_sgm,
)
from qsgm.sgm.ranges import CALIBRATORS, SgmObservers
from qsgm.tables import TIGHT, keyed_table, number
from qsgm.task import label_span
from qsgm.tune.graphs import open_probe
from qsgm.tune.plan import Plan, resolve
from qsgm.tune.prepare import Prepared
from qsgm.tune.probe import activations_of
from qsgm.tune.recalibrate import GROWTH, activations_before, grown, ranges_of, typical_labels
from qsgm.tune.result import Result
from qsgm.tune.run import Keeper, train, tune
from qsgm.tune.settings import Settings

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
Observed = Mapping[int, SgmObservers]

# Of each run on a calibration frame: steps between two looks, crops looked at.
OBSERVE_EVERY_STEPS = 25
OBSERVED_CROPS = 256
DARK = 0.25  # times the brightness
PLAIN_TABLES = ("plain", "gradient")
NOISE_FRAMES = 4
OWN_RUN, OWN_CROPS = "the object itself", "its crops, anew"  # by --recalibrate
# A frame has lost accuracy to quantization if it is off by more than this. Runs whose gradients
# agree differ by up to 0.05 degrees from the float one, of round objects too.
LOST_DETECTION, LOST_ANGLE_DEG, LOST_ANGLE_SHARE = 0.01, 0.1, 0.1
# of one run, in this order
METRICS = (
    "cos_int8_float",  # the lowest of any SGM, mean over the run
    "cos_int8_true",  # mean over SGMs
    "clipped_fraction",  # the highest of any SGM
    "detection_accuracy",
    "angle_mae_deg",
    "warned",
)
COS_FLOAT, COS_TRUE, CLIPPED, DETECTION, ANGLE, WARNED = range(len(METRICS))
LEGEND = """N/M: bits of activations/weights; means over frames; cos: of int8 to float
gradients, and the worst frame's; true: to true ones; clip: share of inputs
outside their ranges; angle: error in degrees, modulo 180°; lost: share of
frames worse than with float SGMs; warned: share of frames with a warning"""


# key of a summary, heading, format
_COLUMNS = (
    ("cos_int8_float", "cos", "{:.4f}"),
    ("cos_int8_float_worst", "worst", "{:.4f}"),
    ("cos_int8_true", "cos true", "{:.3f}"),
    ("clipped_fraction", "clip", "{:.2%}"),
    ("detection_accuracy", "detect", "{:.3f}"),
    ("angle_mae_deg", "angle", "{:.2f}"),
    ("lost", "lost", "{:.0%}"),
    ("warned", "warned", "{:.0%}"),
)


@dataclass(frozen=True)
class Variant:
    """How SGMs are quantized."""

    activation_bits: ActivationBits
    weight_bits: WeightBits
    calibrator: str

    def __str__(self) -> str:
        return f"{self.activation_bits}/{self.weight_bits}/{self.calibrator}"


def parse_variant(text: str) -> Variant:
    """A variant as it prints, such as `8/16/minmax`. Raises QsgmError for anything else."""
    known = [Variant(*one) for one in product(ACTIVATION_BITS, WEIGHT_BITS, CALIBRATORS)]
    for variant in known:
        if str(variant) == text:
            return variant
    bits = [", ".join(map(str, some)) for some in (ACTIVATION_BITS, WEIGHT_BITS)]
    raise QsgmError(
        f"{text!r} is no variant: expected bits of activations ({bits[0]}) and of weights "
        f"({bits[1]}) and a calibrator ({', '.join(CALIBRATORS)}), such as 8/16/minmax"
    )


# (layer, variant) -> what its SGM has to cover
RangesOf = Callable[[int, Variant], SgmRanges]
VARIANTS = (
    Variant(16, 16, "minmax"),
    Variant(8, 16, "minmax"),
    Variant(8, 16, "percentile"),
    Variant(8, 16, "mse"),
    Variant(8, 16, "entropy"),
    Variant(8, 8, "minmax"),
    Variant(8, 6, "minmax"),
    Variant(8, 4, "minmax"),
)


@dataclass(frozen=True)
class CalibrationReport:
    """One run per source of ranges, variant and frame."""

    settings: Settings
    bundle: Bundle
    frames: tuple[BenchFrame, ...]
    sources: tuple[str, ...]  # from far to near
    variants: tuple[Variant, ...]
    results: Floats  # (sources, variants, frames, METRICS)
    floating: Floats  # (frames, METRICS), with the float SGMs

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Which runs lost accuracy to quantization: (sources, variants, frames)."""
        angle, reference = self.results[..., ANGLE], self.floating[:, ANGLE]
        margin = np.maximum(LOST_ANGLE_DEG, LOST_ANGLE_SHARE * reference)
        missed = self.floating[:, DETECTION] - self.results[..., DETECTION] > LOST_DETECTION
        return np.asarray(missed | (angle > reference + margin))

    @property
    def elongated(self) -> NDArray[np.bool_]:
        """Frames whose angle means something; all of them if nobody said."""
        known = np.array([frame.elongated is True for frame in self.frames])
        return known if known.any() else np.ones(len(self.frames), bool)

    def watch_rates(self) -> dict[str, float | None]:
        """How often the warning came where accuracy was lost, and where it was not."""
        warned = self.results[..., WARNED] > 0
        rates = {"warned_of_lost": warned[self.lost], "warned_of_kept": warned[~self.lost]}
        counts = {"lost": int(self.lost.sum()), "kept": int((~self.lost).sum())}
        shares = {
            name: number(float(values.mean()), 4) if len(values) else None
            for name, values in rates.items()
        }
        return {**shares, **counts}

    def summary(self, source: int, variant: int) -> dict[str, float | None]:
        """One row of the table."""
        runs = self.results[source, variant]
        return {
            "cos_int8_float": number(runs[:, COS_FLOAT].mean(), 6),
            "cos_int8_float_worst": number(runs[:, COS_FLOAT].min(), 6),
            "cos_int8_true": number(runs[:, COS_TRUE].mean(), 4),
            "clipped_fraction": number(runs[:, CLIPPED].mean(), 6),
            "detection_accuracy": number(runs[:, DETECTION].mean(), 4),
            "angle_mae_deg": number(runs[self.elongated, ANGLE].mean(), 3),
            "lost": number(self.lost[source, variant].mean(), 4),
            "warned": number(runs[:, WARNED].mean(), 4),
        }

    def to_json(self) -> dict[str, Any]:
        floating = self.floating
        return {
            "bundle": str(self.bundle.folder),
            "layers": self.settings.layers,
            "epochs": self.settings.epochs,
            "seed": self.settings.seed,
            "frames": [frame.name for frame in self.frames],
            "angles_of_frames": int(self.elongated.sum()),
            "float": {
                "cos_float_true": number(floating[:, COS_TRUE].mean(), 4),
                "detection_accuracy": number(floating[:, DETECTION].mean(), 4),
                "angle_mae_deg": number(floating[self.elongated, ANGLE].mean(), 3),
                "per_frame": floating.round(6).tolist(),
            },
            "metrics": list(METRICS),
            "sources": {
                source: {
                    str(variant): self.summary(i, k)
                    | {"per_frame": self.results[i, k].round(6).tolist()}
                    for k, variant in enumerate(self.variants)
                }
                for i, source in enumerate(self.sources)
            },
            "watch": self.watch_rates(),
        }


def measure_calibration(
    frames: Sequence[BenchFrame],
    calibration_folder: Path,
    bundle: Bundle,
    settings: Settings,
    watch: Progress,
    variants: Sequence[Variant] = VARIANTS,
) -> CalibrationReport:
    """Calibrate on every set, tune every frame with what comes of it.

    Args:
        frames: to judge on, one by one; none should be in the calibration sets.
        calibration_folder: that the sets are made of.
        bundle: whose SGMs are quantized; of 16 bit activations.
        settings: of every run but for the precision: all variants are int8.
        variants: calibrators and bits.
        watch: told about progress.

    Raises:
        QsgmError: a frame cannot be used, the bundle's SGMs have another number of bits, or a run
            diverged.
    """
    settings = replace(settings, precision="int8")
    plan, floats = (resolve(replace(settings, precision=name), bundle) for name in PRECISIONS)
    layers = plan.layers[:-1]
    if any(bundle.activation_bits(layer) != 16 for layer in layers):
        raise QsgmError(
            f"the bundle {bundle.folder} holds SGMs with 8 bit activations, expected 16: other "
            "calibrations do not fit its graphs; export it with `--activation-bits 16`"
        )
    sets = calibration_sets(calibration_folder)
    sources = {}
    for done, (name, images) in enumerate(sets.items()):
        watch("calibrate", done, len(sets))
        sources[name] = ranges_seen(observe_set(images, bundle, floats), bundle)
    watch("calibrate", len(sets), len(sets))
    results, floating = [], []
    for done, frame in enumerate(frames):
        watch("judge", done, len(frames))
        prepared = prepare_object(frame.read(), bundle, plan)
        floating.append(metrics_of(tune(prepared, floats)))
        own = own_sources(prepared, floats)
        results.append(judge(prepared, plan, [*sources.values(), *own.values()], variants))
    watch("judge", len(frames), len(frames))
    return CalibrationReport(
        settings,
        bundle,
        tuple(frames),
        (*sources, *own),
        tuple(variants),
        np.array(results).transpose(1, 2, 0, 3),
        np.array(floating),
    )


def calibration_sets(folder: Path) -> dict[str, list[Image]]:
    """Frames to calibrate on, by set, from the least like any other frame to the most."""
    frames = list_frames(folder)
    images = [frame.read() for frame in frames]
    plain = [image for image, kind in zip(images, table_kinds(folder), strict=True) if kind]
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 256, images[0].shape, dtype=np.uint8) for _ in range(NOISE_FRAMES)]
    return {
        "random noise": noise,
        "one dark object": [darkened(images[0])],
        "all of them, dark": [darkened(image) for image in images],
        "one object": images[:1],
        **({"plain tables only": plain} if plain else {}),
        f"{len(images)} mixed frames": images,
    }


def darkened(image: Image) -> Image:
    """The same frame in little light."""
    return (DARK * image).astype(np.uint8)


def table_kinds(folder: Path) -> list[bool]:
    """Of each frame, whether the manifest says that its table is a plain one."""
    path = folder / MANIFEST
    entries = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else []
    entries = entries.get("frames", []) if isinstance(entries, dict) else entries
    kinds = [entry.get("table_kind") in PLAIN_TABLES for entry in entries]
    return kinds or [False] * len(list_frames(folder))


def observe_set(images: Sequence[Image], bundle: Bundle, plan: Plan) -> Observed:
    """What each SGM sees in float runs on some frames, whose crops are dropped one by one."""
    total = {layer: SgmObservers(bundle.float_sgm(layer)) for layer in plan.layers[:-1]}
    for image in images:
        prepared = prepare_object(image, bundle, plan)
        for layer, observers in observe_run(prepared, plan).items():
            total[layer].merge(observers)
    return total


def observe_run(prepared: Prepared, plan: Plan) -> Observed:
    """What each SGM sees in one float run, every now and then on some of the crops."""
    steps = plan.epochs * steps_per_epoch(prepared.taught)
    keeper = Keeper(range(0, steps + 1, OBSERVE_EVERY_STEPS))
    train(prepared, plan, (keeper,))
    rng = np.random.default_rng([plan.settings.seed, 3])
    sgms = {layer: prepared.bundle.float_sgm(layer) for layer in plan.layers[:-1]}
    observers = {layer: SgmObservers(sgm) for layer, sgm in sgms.items()}
    session = open_probe(prepared.bundle, plan)
    for weights in keeper.kept.values():
        rows = rng.choice(prepared.taught, OBSERVED_CROPS, replace=False)
        labels = prepared.labels[rows][:, None]  # (B, 1, L)
        for layer, x in activations_of(session, prepared, plan, weights, rows).items():
            seen = np.concatenate([x, np.repeat(labels, x.shape[1], axis=1)], axis=2)
            observers[layer].update(seen, float_trace(sgms[layer], seen)[1])
    return observers


def ranges_seen(observed: Observed, bundle: Bundle) -> RangesOf:
    """Ranges by what was observed along runs."""
    span = label_span(bundle.manifest.heads)

    def ranges(layer: int, variant: Variant) -> SgmRanges:
        return observed[layer].ranges(variant.calibrator, 2**variant.activation_bits, span)

    return ranges


def own_sources(prepared: Prepared, plan: Plan) -> dict[str, RangesOf]:
    """The nearest there is: a run on the very object, and its crops before any run."""
    bundle, span = prepared.bundle, label_span(prepared.bundle.manifest.heads)
    labels = typical_labels(prepared.labels[: prepared.taught])
    crops = {
        layer: ranges_of(bundle.float_sgm(layer), activation, labels, span)
        for layer, activation in activations_before(prepared, plan).items()
    }

    def ranges(layer: int, variant: Variant) -> SgmRanges:
        return grown(crops[layer], GROWTH[variant.activation_bits], labels.shape[1])

    return {OWN_RUN: ranges_seen(observe_run(prepared, plan), bundle), OWN_CROPS: ranges}


def judge(
    prepared: Prepared, plan: Plan, sources: Sequence[RangesOf], variants: Sequence[Variant]
) -> list[list[list[float]]]:
    """Metrics of one run per source and variant on one frame."""
    return [
        [metrics_of(tune(prepared, exchanged(prepared.bundle, plan, *one))) for one in some]
        for some in ([(ranges, variant) for variant in variants] for ranges in sources)
    ]


def exchanged(bundle: Bundle, plan: Plan, ranges: RangesOf, variant: Variant) -> Plan:
    """The same run by the bundle's graphs, its SGMs quantized in another way."""
    overrides = {}
    for layer in plan.sgm_blocks.sgm_layers:
        bits = variant.activation_bits, variant.weight_bits
        q = quantize_sgm(bundle.float_sgm(layer), ranges(layer, variant), *bits)
        overrides[layer] = constants(q) if q.bits == 16 else constants_of_two_planes(q)
    return replace(plan, overrides=overrides)


def metrics_of(result: Result) -> list[float]:
    """One run's, in the order of :data:`METRICS`."""
    layers = result.fidelity.values()
    return [
        min(layer.cos_int8_float for layer in layers),
        float(np.mean([layer.cos_int8_true for layer in layers])),
        max(layer.clipped_fraction for layer in layers),
        result.scores["detection_accuracy"] or 0.0,
        result.scores["angle_mae_deg"] or 0.0,
        float(bool(result.warnings)),
    ]


def render(values: Mapping[str, Any]) -> RenderableType:
    """A table per variant, its rows from far to near."""
    floating, sources = values["float"], values["sources"]
    title = (
        f"float SGMs: cos to true {floating['cos_float_true']:.3f}, detection"
        f" {floating['detection_accuracy']:.3f}, angle {floating['angle_mae_deg']:.2f}"
    )
    tables = [
        keyed_table(
            variant,
            "calibrated on",
            _COLUMNS,
            {name: row[variant] for name, row in sources.items()},
            padding=TIGHT,
        )
        for variant in next(iter(sources.values()))
    ]
    rates = ", ".join(f"{name} {value}" for name, value in values["watch"].items())
    return Group(Text(title), *tables, Text(f"watch: {rates}"), Text(LEGEND))
