"""Ranges for the int8 SGMs, and how faithful the int8 SGMs are, along whole fine-tuning runs.

Activations move while layers train, so ranges are taken from the first step to the last, on every
calibration frame, channel by channel. Values are looked at and dropped: one frame is in memory at
a time, and of each run only its current step.
"""

import hashlib
import json
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from math import isfinite
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from qsgm.blocks import single_layers
from qsgm.errors import QsgmError
from qsgm.fidelity import LayerFidelity, compare, mean_over_run
from qsgm.images import read_demonstration
from qsgm.train.checkpoint import Checkpoint
from qsgm.train.fold import (
    FloatArray,
    FoldedConv,
    FoldedNet,
    FoldedSgm,
    fold_net,
    fold_sgm,
    run_folded_conv,
)
from qsgm.train.graspnet import LAYERS
from qsgm.train.local import LayerState, local_step, loss_gradient, true_gradients
from qsgm.train.maml import MOMENTUM
from qsgm.train.quantize import QuantizedSgm, SgmRanges, integer_forward
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
# The label is known before anything is seen: quality, sine, cosine.
LABEL_LOW = np.array([0, -1, -1], np.float32)
LABEL_HIGH = np.array([1, 1, 1], np.float32)
# Steps between two measurements of fidelity; consecutive steps tell the same.
MEASURE_EVERY_STEPS = 13
MEASURE_MAPS_EVERY_STEPS = 15

# (what is going on, frames done, of how many)
Watch = Callable[[str, int, int], None]
# (layer, what its SGM sees (B, P, Ci)) -> gradient (B, P, C)
SgmGradient = Callable[[int, FloatArray], FloatArray]


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


class Observer(Protocol):
    """Watches the channels of one tensor and says what span of values int8 has to cover."""

    def update(self, values: FloatArray) -> None:
        """Look at values (..., C) before they are dropped."""
        ...

    def merge(self, other: Self) -> None:
        """Take in what another observer of the same tensor has seen."""
        ...

    def span(self) -> tuple[FloatArray, FloatArray]:
        """Low and high end of each channel, (C,) each."""
        ...


class MinMax:
    """Everything that was seen."""

    name = "minmax"

    def __init__(self, channels: int) -> None:
        self._low = np.full(channels, np.inf, np.float32)
        self._high = np.full(channels, -np.inf, np.float32)

    def update(self, values: FloatArray) -> None:
        flat = values.reshape(-1, values.shape[-1])
        self._include(flat.min(axis=0), flat.max(axis=0))

    def merge(self, other: Self) -> None:
        self._include(*other.span())

    def span(self) -> tuple[FloatArray, FloatArray]:
        return self._low, self._high

    def _include(self, low: FloatArray, high: FloatArray) -> None:
        # Not in place: what `span` gave away stays as it was.
        self._low, self._high = np.minimum(self._low, low), np.maximum(self._high, high)


class SgmObservers:
    """Observers of everything in one SGM that gets a range: its activation, its hidden tensors."""

    def __init__(self, sgm: FoldedSgm, make: Callable[[int], Observer] = MinMax) -> None:
        self._activation = make(len(sgm.convs[-1].bias))
        self._hidden = [make(len(conv.bias)) for conv in sgm.convs[:-1]]

    def update(self, seen: FloatArray, hidden: list[FloatArray]) -> None:
        """One batch: inputs (B, P, Ci) and hidden tensors (B, P, H), after ReLU."""
        self._activation.update(seen[..., : -len(LABEL_LOW)])
        for observer, values in zip(self._hidden, hidden, strict=True):
            observer.update(values)

    def merge(self, other: "SgmObservers") -> None:
        """Take in what was seen on another frame."""
        self._activation.merge(other._activation)
        for observer, others in zip(self._hidden, other._hidden, strict=True):
            observer.merge(others)

    def ranges(self) -> SgmRanges:
        """What the SGM's int8 version has to cover."""
        low, high = self._activation.span()
        return SgmRanges(
            np.concatenate([low, LABEL_LOW]),
            np.concatenate([high, LABEL_HIGH]),
            tuple(observer.span()[1] for observer in self._hidden),
        )


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
    trainee: Trainee, frames: CalibrationSet, seed: int, watch: Watch, epochs: int = EPOCHS
) -> dict[int, SgmRanges]:
    """Fine-tune on every frame with the float SGMs and take each SGM's ranges on the way.

    Layers are tuned by twos and by threes: the SGM behind layer 5 serves both. Where SGMs stand
    behind layers 1 to 3 all layers are tuned as well, see :data:`MAP_EPOCHS`.

    Args:
        trainee: what to fine-tune.
        frames: the calibration set.
        seed: of crops and batches.
        watch: told about progress.
        epochs: length of a whole run.

    Returns:
        Ranges by layer.

    Raises:
        QsgmError: a run diverged, or a frame cannot be used.
    """
    total = {layer: SgmObservers(sgm) for layer, sgm in trainee.sgms.items()}
    for i in range(len(frames)):
        watch("calibrate", i, len(frames))
        for layer, observers in observe_frame(trainee, frames[i], [seed, i], epochs).items():
            total[layer].merge(observers)
    watch("calibrate", len(frames), len(frames))
    return {layer: observers.ranges() for layer, observers in total.items()}


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
    most = trainee.checkpoint.most_layers
    # Two layers are part of three.
    plans = [plan for plan in run_plans(most, epochs) if plan.tuned >= min(most, ONE_POSITION)]
    for i in range(len(frames)):
        watch("measure", i, len(frames))
        for plan in plans:
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

    every = MEASURE_MAPS_EVERY_STEPS if plan.maps else MEASURE_EVERY_STEPS
    for moment in islice(run(trainee, demonstration, plan, seed, driver), 0, None, every):
        yield from compare_moment(trainee, int8_sgms, moment, plan.measured).items()


def compare_moment(
    trainee: Trainee, int8_sgms: Mapping[int, QuantizedSgm], moment: Moment, layers: range
) -> dict[int, LayerFidelity]:
    """Int8, float and true gradients on one batch behind `layers`, as they are at that moment."""
    true = true_gradients(moment.states, moment.features, moment.labels, trainee.checkpoint.loss)
    fidelity = {}

    def gradient(layer: int, seen: FloatArray) -> FloatArray:
        floating, _ = float_trace(trainee.sgms[layer], seen)
        if layer in layers:
            int8, clipped = integer_forward(int8_sgms[layer], seen)
            fidelity[layer] = compare(int8, floating, true[layer][0].numpy(), clipped)
        return floating

    still = [torch.zeros(())] * len(moment.states)
    step(trainee, moment, still, gradient)
    return fidelity


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
    """An SGM in float: inputs (B, P, Ci) to gradient (B, P, C) and hidden tensors (B, P, H)."""
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
