"""What is learnt on a device: output heads as data, and what a task has to provide.

A network's last layer gives one channel after the other to its heads. A head is a group of channels
with an activation and a loss; its labels are as many numbers. An SGM sees a sample's labels beside
an activation, so that they need a known range, which the activation has.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from math import inf
from typing import Any, Literal, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from qsgm.errors import QsgmError
from qsgm.network import Network

Array = NDArray[np.float32]
Rows = NDArray[np.int64]
Inputs = NDArray[np.uint8] | NDArray[np.float32]
# What held-out samples say of a network, by name.
Scores = Mapping[str, float | None]

LossKind = Literal["log_loss", "squared", "cross_entropy"]
Activation = Literal["sigmoid", "tanh", "softmax"]
ACTIVATIONS: Mapping[LossKind, tuple[Activation, ...]] = {
    "log_loss": ("sigmoid",),
    "squared": ("tanh", "sigmoid"),
    "cross_entropy": ("softmax",),
}


@dataclass(frozen=True)
class Head:
    """A group of output channels, and their loss as data.

    Raises:
        QsgmError: the activation does not go with the loss, or a number makes no sense.
    """

    name: str
    kind: LossKind
    channels: int
    activation: Activation
    weight: float = 1.0  # of its loss in the sum over heads
    smoothing: float = 0.0  # of labels that are classes: how far they are from 0 and 1
    where: int | None = None  # counts only in samples in which this label (of all) is not 0

    def __post_init__(self) -> None:
        if self.activation not in ACTIVATIONS.get(self.kind, ()):
            raise QsgmError(f"head {self.name!r}: {self.kind} with {self.activation} is no loss")
        positive = 0 < self.weight < inf
        if not (self.channels >= 1 and positive and 0 <= self.smoothing < 1):
            raise QsgmError(
                f"head {self.name!r}: expected a channel or more, a positive weight and smoothing "
                f"in [0, 1), got {self.channels}, {self.weight:g}, {self.smoothing:g}"
            )

    @property
    def label_low(self) -> float:
        """The smallest value of its labels."""
        return -1.0 if self.activation == "tanh" else 0.0


Heads = tuple[Head, ...]


def output_count(heads: Sequence[Head]) -> int:
    """Channels of all heads, and labels of a sample."""
    return sum(head.channels for head in heads)


def channels_of(heads: Sequence[Head]) -> list[range]:
    """Numbers of every head's channels."""
    ends = np.cumsum([0, *(head.channels for head in heads)]).tolist()
    return [range(first, end) for first, end in pairwise(ends)]


def label_span(heads: Sequence[Head]) -> tuple[Array, Array]:
    """Smallest and largest value of every label, (L,) each."""
    low = np.concatenate([np.full(head.channels, head.label_low, np.float32) for head in heads])
    return low, np.ones_like(low)


def heads_from_json(values: Any) -> Heads:
    """Read heads from plain values, trusting nothing in them. Raises QsgmError."""
    try:
        heads = tuple(_head_from(one) for one in values)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise QsgmError(f"this is no description of output heads ({error})") from error
    total = output_count(heads)
    if not heads or any(head.where is not None and head.where >= total for head in heads):
        raise QsgmError("output heads: expected one or more, each depending on one of the labels")
    return heads


def heads_to_json(heads: Sequence[Head]) -> list[dict[str, Any]]:
    """Heads as plain values."""
    return [asdict(head) for head in heads]


class Labelled(Protocol):
    """Samples with their labels, which may depend on the untouched network's answers."""

    @property
    def labels(self) -> Array:
        """Labels of all samples, (N, L)."""
        ...

    def scores(self, outputs: Array, rows: Rows) -> Scores:
        """What activated outputs (B, L) on the samples `rows` are worth."""
        ...


class Lesson(Protocol):
    """Samples of what a device is shown, made when they are asked for."""

    @property
    def taught(self) -> int:
        """How many are learnt from; those behind them are held out."""
        ...

    def __len__(self) -> int: ...

    def cut(self, rows: Rows) -> Inputs:
        """Inputs (B, height, width, channels) of the samples `rows`."""
        ...

    def labelled(self, untouched: Array) -> Labelled:
        """Label all samples, knowing the untouched network's activated outputs (N, L) on them."""
        ...


class Described(Protocol):
    """A task as a bundle or a checkpoint keeps it."""

    @property
    def name(self) -> str:
        """By which a bundle names it."""
        ...

    @property
    def network(self) -> Network:
        """The geometry of its network."""
        ...

    @property
    def heads(self) -> Heads:
        """What its network gives."""
        ...

    def to_json(self) -> dict[str, Any]:
        """What is kept of it beside its name, network and heads."""
        ...


class Task(Described, Protocol):
    """What a network is for."""

    def scores(self, outputs: Array, labels: Array) -> Scores:
        """What activated outputs (N, L) are worth beside labels (N, L)."""
        ...


@dataclass(frozen=True)
class TaskRecord:
    """What was kept of a task."""

    name: str
    network: Network
    heads: Heads
    settings: Mapping[str, Any]  # what the task itself reads

    def to_json(self) -> dict[str, Any]:
        return dict(self.settings)


def task_record(task: Described) -> TaskRecord:
    """A task as it is kept."""
    return TaskRecord(task.name, task.network, task.heads, task.to_json())


def _head_from(values: Any) -> Head:
    where = values["where"]
    kind, activation = values["kind"], values["activation"]
    if kind not in get_args(LossKind) or not isinstance(values["name"], str):
        raise ValueError("a head has a name and a known loss")
    whole = (values["channels"], 0 if where is None else where)
    if not all(type(value) is int and value >= 0 for value in whole):
        raise TypeError("`channels` and `where` are whole numbers")
    numbers = values["weight"], values["smoothing"]
    if not all(type(value) in (int, float) for value in numbers):
        raise TypeError("`weight` and `smoothing` are numbers")
    weight, smoothing = map(float, numbers)
    return Head(values["name"], kind, values["channels"], activation, weight, smoothing, where)
