"""Ranges for the int8 SGMs, and how faithful the int8 SGMs are, along whole fine-tuning runs.

Activations move while layers train, so ranges are taken from the first step to the last, on every
calibration frame, channel by channel. Values are looked at and dropped: one frame is in memory at
a time, and of each run only its current step.

Which calibrator suits a layer is not known beforehand. The default tries them all on some of the
frames, with ranges from the others, and takes for each layer the one whose int8 gradients point
most nearly where the float ones do.
"""

import hashlib
import json
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from qsgm.blocks import single_layers, tuned_layers
from qsgm.errors import QsgmError
from qsgm.fidelity import Gradients, LayerFidelity, compare, cosine, mean_over_run
from qsgm.folded import FloatArray, FoldedConv, FoldedSgm
from qsgm.images import read_demonstration
from qsgm.observers import CALIBRATORS, SgmObservers
from qsgm.quantize import (
    ActivationBits,
    QuantizedSgm,
    SgmRanges,
    integer_forward,
    quantize_sgm,
    underflow_fraction,
)
from qsgm.train.checkpoint import Checkpoint
from qsgm.train.fold import FoldedNet, fold_net, fold_sgm, run_folded_conv
from qsgm.train.graspnet import LAYERS
from qsgm.train.local import (
    LayerState,
    columns,
    layer_forward,
    local_step,
    loss_gradient,
    through_activation,
    true_gradients,
    weight_gradients,
)
from qsgm.train.maml import MOMENTUM
from qsgm.train.tasks import Task, make_task, start_states
from qsgm.tuning import BATCH, rate_factor
from qsgm.weights import to_step_layout

MANIFEST = "manifest.json"
FORMAT, VERSION = "qsgm-calibration", 1
CROPS = 400
EPOCHS = 40  # as many steps as 20 epochs on the 800 crops of the device
# The most layers whose SGMs all see one position per crop. Those further ahead see whole maps, so
# that a step takes about a hundred times as long: whole runs of them would take hours.
ONE_POSITION = 3
# A run of all layers is therefore a short one, its rates decaying as fast, on the same frames. The
# activations of those layers move little, and every crop gives as many samples as its map is large.
MAP_CROPS = 96
MAP_EPOCHS = 10
# Steps between two measurements of fidelity; consecutive steps tell the same.
MEASURE_EVERY_STEPS = 13
MEASURE_MAPS_EVERY_STEPS = 15
# Not a calibrator: for each layer the best of them.
AUTO = "auto"
HELD_OUT_EVERY = 4
EQUAL_COSINE = 1e-5

# (what is going on, frames done, of how many)
Watch = Callable[[str, int, int], None]
# (layer, what its SGM sees (B, P, Ci)) -> gradient (B, P, C)
SgmGradient = Callable[[int, FloatArray], FloatArray]
# layer: calibrator: the SGM
Candidates = Mapping[int, Mapping[str, QuantizedSgm]]


@dataclass(frozen=True)
class Demonstration:
    """A frame (H, W, 3) BGR and the object's centre (x, y) in it [px]."""

    image: NDArray[np.uint8]
    center_px: tuple[float, float]


@dataclass(frozen=True)
class _Entry:
    """What the manifest says of one frame: a name in the same folder, its digest, its object."""

    file: str
    sha256: str
    center_px: tuple[float, float]


class CalibrationSet:
    """The frames that a folder's manifest lists; each is read when its turn comes."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        path = folder / MANIFEST
        try:
            self.manifest_bytes = path.read_bytes()
            self._entries = _entries(json.loads(self.manifest_bytes))
        except OSError as error:
            raise QsgmError(
                f"{folder} is no calibration set, it has no {MANIFEST};"
                f" make one with `qsgm draw-calibration -o {folder}`"
            ) from error
        except (ValueError, KeyError, TypeError, ArithmeticError, RecursionError) as error:
            raise QsgmError(
                f'{path} is damaged: expected {{"frames": [{{"file", "sha256", "center_px"}}]}};'
                " make it again with `qsgm draw-calibration`"
            ) from error
        if not self._entries:
            raise QsgmError(f"{path} lists no frames: there is nothing to calibrate on")

    def __len__(self) -> int:
        return len(self._entries)

    def __getitem__(self, i: int) -> Demonstration:
        entry = self._entries[i]
        path = self.folder / entry.file
        image = read_demonstration(path)
        if hashlib.sha256(path.read_bytes()).hexdigest() != entry.sha256:
            raise QsgmError(
                f"{path} is not the frame the manifest describes (its sha256"
                " differs); restore it or make the set again with `qsgm draw-calibration`"
            )
        (x, y), (height, width) = entry.center_px, image.shape[:2]
        if x >= width or y >= height:
            raise QsgmError(
                f"{self.folder / MANIFEST} has the object of {entry.file} at ({x:g}, {y:g}) px,"
                f" outside its frame of {width}x{height}; correct its center_px"
            )
        return Demonstration(image, entry.center_px)


def _entries(manifest: Any) -> list[_Entry]:
    """Every frame's entry; the manifest may name its format and version.

    Raises ValueError, KeyError, TypeError, ArithmeticError or RecursionError for a damaged one.
    """
    if not isinstance(manifest, dict):
        raise TypeError("not a JSON object")
    named = manifest.get("format", FORMAT), manifest.get("version", VERSION)
    if named != (FORMAT, VERSION):
        raise ValueError(f"another format: {named!r}")
    return [
        _entry(**{name: f[name] for name in _Entry.__annotations__}) for f in manifest["frames"]
    ]


def _is_plain(name: str) -> bool:
    """Whether a name stays in its folder, and in its line of a message."""
    return name.isprintable() and not re.search(r"[/\\]", name) and name not in ("", ".", "..")


def _entry(file: Any, sha256: Any, center_px: Any) -> _Entry:
    if not isinstance(file, str) or not _is_plain(file):
        raise ValueError(f"not a plain file name: {file!r}")
    if not isinstance(sha256, str):
        raise TypeError(f"no digest: {sha256!r}")
    x, y = center_px
    for value in (x, y):
        if type(value) not in (int, float) or not isfinite(value) or value < 0:
            raise ValueError(f"no place in a frame: {center_px!r}")
    return _Entry(file, sha256, (x, y))


@dataclass(frozen=True)
class Calibration:
    """Every SGM's ranges, whose they are, and why; all by layer."""

    ranges: dict[int, SgmRanges]
    chosen: dict[int, str]  # calibrator
    # calibrator: mean cosine of int8 to float gradients; empty where none was to be chosen
    cosines: dict[int, dict[str, float]]
    # Frames that the cosines were measured on and the ranges then compared were not taken from;
    # 0: both were all frames.
    held_out: int


@dataclass(frozen=True)
class Trainee:
    """What is fine-tuned: a checkpoint, and what the device gets of it."""

    checkpoint: Checkpoint
    net: FoldedNet
    sgms: Mapping[int, FoldedSgm]  # by layer

    def start(self, tuned: int) -> list[LayerState]:
        """The last `tuned` layers before the first step."""
        layers = self.net.layers[LAYERS - tuned :]
        return start_states(
            [
                (torch.from_numpy(to_step_layout(layer.weight)).T, torch.from_numpy(layer.bias))
                for layer in layers
            ],
            tasks=1,
        )

    def task(self, demonstration: Demonstration, plan: "RunPlan", seed: list[int]) -> Task:
        """The crops of one frame, as the first of the tuned layers sees them."""
        return make_task(
            self.checkpoint.net,
            demonstration.image,
            np.random.default_rng(seed),
            last_frozen=LAYERS - plan.tuned,
            count=plan.crops,
            loss=self.checkpoint.loss,
            center_px=demonstration.center_px,
        )


@dataclass(frozen=True)
class RunPlan:
    """A fine-tuning run: how many layers, on how many crops, for how many passes over them."""

    tuned: int
    crops: int
    epochs: int

    @property
    def maps(self) -> bool:
        """Whether there are SGMs in it that see whole maps; it is then there for those alone."""
        return self.tuned > ONE_POSITION

    @property
    def measured(self) -> range:
        """The layers of the SGMs that it is there for."""
        return range(LAYERS + 1 - self.tuned, LAYERS + 1 - ONE_POSITION if self.maps else LAYERS)

    @property
    def measure_every(self) -> int:
        """Steps between two measurements."""
        return MEASURE_MAPS_EVERY_STEPS if self.maps else MEASURE_EVERY_STEPS


@dataclass(frozen=True)
class Moment:
    """One step of a run: the tuned layers before it, and the batch that they are about to see."""

    states: list[LayerState]
    features: Tensor  # (1, B, P, C)
    labels: Tensor  # (1, B, 3)


def prepare(checkpoint: Checkpoint) -> Trainee:
    """Fold a checkpoint. Raises QsgmError where batchnorm cannot be folded."""
    sgms = {layer: fold_sgm(sgm) for layer, sgm in sorted(checkpoint.sgms.items())}
    return Trainee(checkpoint, fold_net(checkpoint.net), sgms)


def run_plans(most_layers: int, epochs: int) -> list[RunPlan]:
    """Whole runs of two and of three layers, and a short one of all layers if there are more."""
    whole = range(2, min(most_layers, ONE_POSITION) + 1)
    plans = [RunPlan(tuned, CROPS, epochs) for tuned in whole]
    if most_layers > ONE_POSITION:
        plans.append(RunPlan(most_layers, MAP_CROPS, min(epochs, MAP_EPOCHS)))
    return plans


def calibrate(
    trainee: Trainee,
    frames: CalibrationSet,
    seed: int,
    watch: Watch,
    epochs: int = EPOCHS,
    calibrator: str = AUTO,
    activation_bits: ActivationBits = 16,
) -> Calibration:
    """Fine-tune on every frame with the float SGMs and take each SGM's ranges on the way.

    Layers are tuned by twos and by threes: the SGM behind layer 5 serves both. Where SGMs stand
    behind layers 1 to 3 all layers are tuned as well, see :data:`MAP_EPOCHS`.

    Args:
        trainee: what to fine-tune.
        frames: the calibration set.
        seed: of crops and batches.
        watch: told about progress.
        epochs: length of a whole run.
        calibrator: one of :data:`qsgm.observers.CALIBRATORS`, or :data:`AUTO`: for each layer
            the one that does best on frames held out.
        activation_bits: of the int8 SGMs.

    Raises:
        QsgmError: there is no such calibrator, a run diverged, or a frame cannot be used.
    """
    refuse_unknown(calibrator)
    held_out = held_out_frames(len(frames)) if calibrator == AUTO else range(0)
    everything, compared = observe(trainee, frames, seed, watch, epochs, held_out)
    levels = 2**activation_bits
    if calibrator == AUTO:
        candidates = quantize_all(trainee, compared, activation_bits)
        judges = held_out or range(len(frames))
        cosines = judge(trainee, candidates, frames, judges, seed, watch, epochs)
        chosen = {layer: best_calibrator(cosines[layer]) for layer in trainee.sgms}
    else:
        cosines = {layer: {} for layer in trainee.sgms}
        chosen = dict.fromkeys(trainee.sgms, calibrator)
    ranges = {layer: everything[layer].ranges(chosen[layer], levels) for layer in trainee.sgms}
    return Calibration(ranges, chosen, cosines, len(held_out))


def refuse_unknown(calibrator: str) -> None:
    """Raise QsgmError for a name that is no calibrator's."""
    if calibrator not in (AUTO, *CALIBRATORS):
        raise QsgmError(
            f"there is no calibrator {calibrator!r}; take one of {', '.join((AUTO, *CALIBRATORS))}"
        )


def held_out_frames(count: int) -> range:
    """Every fourth; of fewer frames than that, none can be spared."""
    return range(HELD_OUT_EVERY - 1, count, HELD_OUT_EVERY)


def observe(
    trainee: Trainee,
    frames: CalibrationSet,
    seed: int,
    watch: Watch,
    epochs: int,
    held_out: range,
) -> tuple[dict[int, SgmObservers], dict[int, SgmObservers]]:
    """What each SGM sees in the runs on all frames, and on those that are not held out."""
    everything, compared = (
        {layer: SgmObservers(sgm) for layer, sgm in trainee.sgms.items()} for _ in range(2)
    )
    for i in range(len(frames)):
        watch("calibrate", i, len(frames))
        for layer, seen in observe_frame(trainee, frames[i], [seed, i], epochs).items():
            everything[layer].merge(seen)
            if i not in held_out:
                compared[layer].merge(seen)
    watch("calibrate", len(frames), len(frames))
    return everything, compared


def observe_frame(
    trainee: Trainee, demonstration: Demonstration, seed: list[int], epochs: int
) -> dict[int, SgmObservers]:
    """What each SGM sees in the runs on one frame."""
    observers = {layer: SgmObservers(sgm) for layer, sgm in trainee.sgms.items()}
    for plan in run_plans(trainee.checkpoint.most_layers, epochs):

        def gradient(layer: int, seen: FloatArray, plan: RunPlan = plan) -> FloatArray:
            result, hidden = float_trace(trainee.sgms[layer], seen)
            if layer in plan.measured:
                observers[layer].update(seen, hidden)
            return result

        for _ in run(trainee, demonstration, plan, seed, gradient):
            pass
    return observers


def quantize_all(
    trainee: Trainee, seen: Mapping[int, SgmObservers], activation_bits: ActivationBits
) -> Candidates:
    """The int8 SGMs by every calibrator's ranges."""
    levels = 2**activation_bits
    return {
        layer: {
            name: quantize_sgm(sgm, seen[layer].ranges(name, levels), activation_bits)
            for name in CALIBRATORS
        }
        for layer, sgm in trainee.sgms.items()
    }


def judge(
    trainee: Trainee,
    candidates: Candidates,
    frames: CalibrationSet,
    judges: range,
    seed: int,
    watch: Watch,
    epochs: int,
) -> dict[int, dict[str, float]]:
    """Each calibrator's mean cosine of int8 to float gradients on some frames, by layer.

    The float SGMs drive the runs, so that all calibrators are asked the same.
    """
    cosines: dict[int, dict[str, list[float]]] = {
        layer: {name: [] for name in CALIBRATORS} for layer in candidates
    }
    for done, i in enumerate(judges):
        watch("choose", done, len(judges))
        for plan in measured_plans(trainee, epochs):
            for layer, name, value in judge_run(trainee, candidates, frames[i], plan, [seed, i]):
                cosines[layer][name].append(value)
    watch("choose", len(judges), len(judges))
    return {
        layer: {name: float(np.mean(values)) for name, values in by_name.items()}
        for layer, by_name in cosines.items()
    }


def judge_run(
    trainee: Trainee,
    candidates: Candidates,
    demonstration: Demonstration,
    plan: RunPlan,
    seed: list[int],
) -> Iterator[tuple[int, str, float]]:
    """Every now and then along one run, each calibrator's cosine at each SGM it is there for."""

    def driver(layer: int, seen: FloatArray) -> FloatArray:
        return float_trace(trainee.sgms[layer], seen)[0]

    steps = run(trainee, demonstration, plan, seed, driver)
    for moment in islice(steps, 0, None, plan.measure_every):
        for layer, (seen, floating) in float_moment(trainee, moment).items():
            if layer in plan.measured:
                for name, sgm in candidates[layer].items():
                    yield layer, name, cosine(integer_forward(sgm, seen)[0], floating)


def float_moment(trainee: Trainee, moment: Moment) -> dict[int, tuple[FloatArray, FloatArray]]:
    """What each SGM sees on one batch, and its float gradient; nothing moves."""
    found = {}

    def gradient(layer: int, seen: FloatArray) -> FloatArray:
        floating, _ = float_trace(trainee.sgms[layer], seen)
        found[layer] = seen, floating
        return floating

    still = [torch.zeros(())] * len(moment.states)
    step(trainee, moment, still, gradient)
    return found


def best_calibrator(cosines: Mapping[str, float]) -> str:
    """The one with the highest cosine; of equals the first."""
    best = max(cosines.values())
    return next(name for name, value in cosines.items() if value >= best - EQUAL_COSINE)


def measured_plans(trainee: Trainee, epochs: int) -> list[RunPlan]:
    """The runs that show all SGMs: those of two layers are part of those of three."""
    most = trainee.checkpoint.most_layers
    return [plan for plan in run_plans(most, epochs) if plan.tuned >= min(most, ONE_POSITION)]


def measure(
    trainee: Trainee,
    int8_sgms: Mapping[int, QuantizedSgm],
    frames: CalibrationSet,
    seed: int,
    watch: Watch,
    epochs: int = EPOCHS,
) -> dict[int, LayerFidelity]:
    """Fidelity of each int8 SGM, mean over runs on every frame.

    Behind layers 4 and 5 it is taken along whole runs of the last three layers, and the int8 SGMs
    drive them, as on the device: what they see is what they have led to. Behind layers 1 to 3 it is
    taken along the short runs of all layers, which the float SGMs drive: they are quicker here.
    """
    measured: dict[int, list[LayerFidelity]] = {layer: [] for layer in int8_sgms}
    for i in range(len(frames)):
        watch("measure", i, len(frames))
        for plan in measured_plans(trainee, epochs):
            for layer, fidelity in measure_run(trainee, int8_sgms, frames[i], plan, [seed, i]):
                measured[layer].append(fidelity)
    watch("measure", len(frames), len(frames))
    return {layer: mean_over_run(values) for layer, values in measured.items()}


def measure_run(
    trainee: Trainee,
    int8_sgms: Mapping[int, QuantizedSgm],
    demonstration: Demonstration,
    plan: RunPlan,
    seed: list[int],
) -> Iterator[tuple[int, LayerFidelity]]:
    """Every now and then along one run, what the SGMs that it is there for are worth."""

    def driver(layer: int, seen: FloatArray) -> FloatArray:
        if plan.maps:
            return float_trace(trainee.sgms[layer], seen)[0]
        return integer_forward(int8_sgms[layer], seen)[0]

    steps = run(trainee, demonstration, plan, seed, driver)
    for moment in islice(steps, 0, None, plan.measure_every):
        yield from compare_moment(trainee, int8_sgms, moment, plan.measured).items()


def compare_moment(
    trainee: Trainee, int8_sgms: Mapping[int, QuantizedSgm], moment: Moment, layers: range
) -> dict[int, LayerFidelity]:
    """Int8, float and true gradients on one batch behind `layers`, as they are at that moment."""
    true = true_gradients(moment.states, moment.features, moment.labels, trainee.checkpoint.loss)
    fidelity, passes = {}, passes_of(moment)
    for layer, (seen, floating) in float_moment(trainee, moment).items():
        if layer in layers:
            int8, clipped = integer_forward(int8_sgms[layer], seen)
            given = (int8, floating, true[layer][0].numpy())
            updates = (update_from(layer, *passes[layer], gradient) for gradient in given)
            fidelity[layer] = compare(
                Gradients(*given),
                Gradients(*updates),
                clipped,
                underflow_fraction(int8_sgms[layer], seen),
            )
    return fidelity


def passes_of(moment: Moment) -> dict[int, tuple[Tensor, Tensor]]:
    """By layer, the windows (1, B, P, K) it sees and its pre-activation (1, B, P, C)."""
    passes, x = {}, moment.features
    for layer, state in zip(tuned_layers(len(moment.states)), moment.states, strict=True):
        windows = columns(layer, x)
        before, x = layer_forward(layer, state, windows)
        passes[layer] = windows, before
    return passes


def update_from(layer: int, windows: Tensor, before: Tensor, gradient: FloatArray) -> FloatArray:
    """Gradients of a layer's weight and bias, one after the other, from one on its activation.

    Args:
        layer: its number.
        windows: of its input, (1, B, P, K).
        before: its pre-activation, (1, B, P, C).
        gradient: (B, P', C), each sample's own.
    """
    dz = through_activation(layer, before, torch.from_numpy(gradient)[None])
    parts = weight_gradients(windows, dz)
    return torch.cat([part.flatten() for part in parts]).numpy()


def run(
    trainee: Trainee,
    demonstration: Demonstration,
    plan: RunPlan,
    seed: list[int],
    sgm_gradient: SgmGradient,
) -> Iterator[Moment]:
    """Fine-tune the last layers on one frame as the device does; yields before every step.

    Raises QsgmError when the run diverges.
    """
    task = trainee.task(demonstration, plan, seed)
    states = trainee.start(plan.tuned)
    rates = torch.tensor(trainee.checkpoint.rates[str(single_layers(plan.tuned))])
    done, steps = 0, plan.epochs * -(-len(task.labels) // BATCH)
    generator = torch.Generator().manual_seed(int(np.random.default_rng(seed).integers(2**31)))
    for _ in range(plan.epochs):
        for rows in torch.randperm(len(task.labels), generator=generator).split(BATCH):
            moment = Moment(states, task.features[None, rows], task.labels[None, rows])
            yield moment
            factor = rate_factor(done, steps)
            states = step(trainee, moment, list(factor * rates), sgm_gradient)
            refuse_unless_finite(states)
            done += 1


def refuse_unless_finite(states: list[LayerState]) -> None:
    """Raise QsgmError for a run that has blown up."""
    if not all(torch.isfinite(state.weight).all() for state in states):
        raise QsgmError(
            f"fine-tuning {len(states)} layers on a calibration frame diverged: the checkpoint's"
            " SGMs and rates do not work; pretrain again"
        )


def step(
    trainee: Trainee, moment: Moment, rates: list[Tensor], sgm_gradient: SgmGradient
) -> list[LayerState]:
    """One feed-forward step."""
    loss = trainee.checkpoint.loss

    def gradient_of(layer: int, activation: Tensor, labels: Tensor) -> Tensor:
        if layer == LAYERS:
            return loss_gradient(loss, activation, labels[:, :, None])
        filled = labels[0, :, None].expand(-1, activation.shape[2], -1)
        seen = torch.cat([activation[0], filled], dim=2).numpy()
        return torch.from_numpy(sgm_gradient(layer, seen))[None]

    return local_step(
        moment.states,
        moment.features,
        moment.labels,
        rates,
        gradient_of,
        MOMENTUM,
        trainee.checkpoint.curvatures,
    )


def float_trace(sgm: FoldedSgm, seen: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
    """An SGM in float: inputs (B, P, Ci) to gradient (B, P, C) and hidden tensors (B, P, H).

    As :func:`qsgm.folded.float_trace`, by torch, which takes maps five to ten times as fast.
    """
    x, hidden = seen, []
    for conv in sgm.convs[:-1]:
        x = np.maximum(float_product(conv, x), 0)
        hidden.append(x)
    return float_product(sgm.convs[-1], x), hidden


def float_product(conv: FoldedConv, x: FloatArray) -> FloatArray:
    """A padded convolution of square maps (B, P, I), by torch unless it is 1x1: (B, P, O)."""
    if conv.weight.shape[2] == 1:
        flat = x.reshape(-1, x.shape[2]) @ conv.weight[:, :, 0, 0].T + conv.bias
        return flat.reshape(*x.shape[:2], -1)
    side = round(x.shape[1] ** 0.5)
    maps = torch.from_numpy(x).transpose(1, 2).unflatten(2, (side, side))
    return run_folded_conv(conv, maps).flatten(2).transpose(1, 2).contiguous().numpy()
