"""Losses of output heads, one class per kind: value and error in torch, both in a graph.

Torch differentiates through the first two and is their oracle; the device runs the graph. Nothing
here imports torch before it is given a tensor, so that graphs are built without it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

from qsgm.task import Head, LossKind, channels_of
from qsgm.train.graphs.build import Ops, Value

if TYPE_CHECKING:
    from torch import Tensor

# Under the root of a task's squared error, whose slope at zero would be infinite.
SMALLEST_ERROR = 1e-4


class HeadLoss(Protocol):
    """A head's loss; channels lie last, labels beside them, all of one head."""

    def activate(self, head: Head, raw: Tensor) -> Tensor:
        """Raw outputs (..., C) as the user sees them."""
        ...

    def value(self, head: Head, raw: Tensor, labels: Tensor) -> Tensor:
        """Losses (...) of raw outputs (..., C), neither weighted nor gated."""
        ...

    def error(self, head: Head, raw: Tensor, labels: Tensor) -> Tensor:
        """Derivative of :meth:`value` by the raw outputs, (..., C)."""
        ...

    def graph_activate(self, op: Ops, head: Head, raw: Value) -> Value:
        """:meth:`activate` in a graph; channels are axis 1 of (B, C, ...)."""
        ...

    def graph(
        self, op: Ops, head: Head, raw: Value, labels: Value, gate: Value | None
    ) -> tuple[Value, Value]:
        """Mean loss of a batch, a scalar, and each sample's weighted and gated error (B, C)."""
        ...


class LogLoss:
    """Binary cross entropy of a sigmoid, per channel."""

    def activate(self, head: Head, raw: Tensor) -> Tensor:  # noqa: ARG002
        return raw.sigmoid()

    def value(self, head: Head, raw: Tensor, labels: Tensor) -> Tensor:
        from torch.nn import functional as F

        target = smoothed(head, labels, 2)
        return F.binary_cross_entropy_with_logits(raw, target, reduction="none").sum(dim=-1)

    def error(self, head: Head, raw: Tensor, labels: Tensor) -> Tensor:
        return raw.sigmoid() - smoothed(head, labels, 2)

    def graph_activate(self, op: Ops, head: Head, raw: Value) -> Value:  # noqa: ARG002
        return op.Sigmoid(raw)

    def graph(
        self, op: Ops, head: Head, raw: Value, labels: Value, gate: Value | None
    ) -> tuple[Value, Value]:
        target = smoothed_in_graph(op, head, labels, 2)
        each = op.Sub(op.Softplus(raw), op.Mul(target, raw))
        error = op.Sub(op.Sigmoid(raw), target)
        each, error = (weighed(op, x, head.weight, gate) for x in (each, error))
        return batch_mean(op, each, head.channels), error


class Squared:
    """Squared distance of activated channels to their labels."""

    def activate(self, head: Head, raw: Tensor) -> Tensor:
        return raw.tanh() if head.activation == "tanh" else raw.sigmoid()

    def value(self, head: Head, raw: Tensor, labels: Tensor) -> Tensor:
        return (self.activate(head, raw) - labels).square().sum(dim=-1)

    def error(self, head: Head, raw: Tensor, labels: Tensor) -> Tensor:
        seen = self.activate(head, raw)
        slope = 1 - seen.square() if head.activation == "tanh" else seen * (1 - seen)
        return 2 * ((seen - labels) * slope)

    def graph_activate(self, op: Ops, head: Head, raw: Value) -> Value:
        return op.Tanh(raw) if head.activation == "tanh" else op.Sigmoid(raw)

    def graph(
        self, op: Ops, head: Head, raw: Value, labels: Value, gate: Value | None
    ) -> tuple[Value, Value]:
        seen = self.graph_activate(op, head, raw)
        miss = op.Sub(seen, labels)
        # The derivative of the loss by the activated channels.
        pull = weighed(op, miss, 2 * head.weight, gate)
        # Half of pull * miss, summed over channels, is half of their number times the mean.
        mean = batch_mean(op, op.Mul(pull, miss), head.channels / 2)
        one = op.constant(1.0)
        if head.activation == "tanh":
            return mean, op.Mul(pull, op.Sub(one, op.Mul(seen, seen)))
        return mean, op.Mul(pull, op.Mul(seen, op.Sub(one, seen)))


class CrossEntropy:
    """Cross entropy of a softmax over all channels; labels are a class in one-hot form."""

    def activate(self, head: Head, raw: Tensor) -> Tensor:  # noqa: ARG002
        return raw.softmax(dim=-1)

    def value(self, head: Head, raw: Tensor, labels: Tensor) -> Tensor:
        return -(smoothed(head, labels, head.channels) * raw.log_softmax(dim=-1)).sum(dim=-1)

    def error(self, head: Head, raw: Tensor, labels: Tensor) -> Tensor:
        return raw.softmax(dim=-1) - smoothed(head, labels, head.channels)

    def graph_activate(self, op: Ops, head: Head, raw: Value) -> Value:  # noqa: ARG002
        return op.Softmax(raw, axis=1)

    def graph(
        self, op: Ops, head: Head, raw: Value, labels: Value, gate: Value | None
    ) -> tuple[Value, Value]:
        target = smoothed_in_graph(op, head, labels, head.channels)
        each = op.Neg(op.Mul(target, op.LogSoftmax(raw, axis=1)))
        error = op.Sub(op.Softmax(raw, axis=1), target)
        each, error = (weighed(op, x, head.weight, gate) for x in (each, error))
        return batch_mean(op, each, head.channels), error


LOSSES: Mapping[LossKind, HeadLoss] = {
    "log_loss": LogLoss(),
    "squared": Squared(),
    "cross_entropy": CrossEntropy(),
}


def smoothed(head: Head, labels: Tensor, classes: int) -> Tensor:
    """Labels (..., C) of so many classes drawn together by the head's smoothing."""
    return labels * (1 - head.smoothing) + head.smoothing / classes


def smoothed_in_graph(op: Ops, head: Head, labels: Value, classes: int) -> Value:
    """:func:`smoothed` in a graph; labels as they are where the head has no smoothing."""
    if not head.smoothing:
        return labels
    kept = op.Mul(labels, op.constant(1 - head.smoothing))
    return op.Add(kept, op.constant(head.smoothing / classes))


def weighed(op: Ops, x: Value, weight: float, gate: Value | None) -> Value:
    """Rows (B, C) times a weight and, where there is one, a gate (B, 1)."""
    if gate is not None:
        scaled = gate if weight == 1 else op.Mul(gate, op.constant(weight))
        return op.Mul(scaled, x)
    return x if weight == 1 else op.Mul(x, op.constant(weight))


def batch_mean(op: Ops, x: Value, factor: float) -> Value:
    """The mean of all numbers of (B, C) times a factor, which makes sums of means."""
    mean = op.ReduceMean(x, keepdims=0)
    return mean if factor == 1 else op.Mul(mean, op.constant(factor))


def activate(heads: Sequence[Head], raw: Tensor) -> Tensor:
    """Raw outputs (..., O) of all heads, activated."""
    import torch

    parts = [
        LOSSES[head.kind].activate(head, raw[..., place.start : place.stop])
        for head, place in zip(heads, channels_of(heads), strict=True)
    ]
    return torch.cat(parts, dim=-1)


def per_sample(heads: Sequence[Head], raw: Tensor, labels: Tensor) -> Tensor:
    """Losses (...) of raw outputs and labels, (..., O) each: the sum over heads."""
    total = raw.new_zeros(raw.shape[:-1])
    for head, place in zip(heads, channels_of(heads), strict=True):
        some = slice(place.start, place.stop)
        value = LOSSES[head.kind].value(head, raw[..., some], labels[..., some])
        total = total + head.weight * _gated(head, labels, value)
    return total


def mean_loss(heads: Sequence[Head], raw: Tensor, labels: Tensor) -> Tensor:
    """Mean over all samples, a scalar."""
    return per_sample(heads, raw, labels).mean()


def error(heads: Sequence[Head], raw: Tensor, labels: Tensor) -> Tensor:
    """Derivative of each sample's loss by its raw outputs; (..., O) each."""
    import torch

    parts = []
    for head, place in zip(heads, channels_of(heads), strict=True):
        some = slice(place.start, place.stop)
        found = LOSSES[head.kind].error(head, raw[..., some], labels[..., some])
        gate = 1.0 if head.where is None else labels[..., head.where : head.where + 1]
        parts.append(head.weight * gate * found)
    return torch.cat(parts, dim=-1)


def meta_objective(heads: Sequence[Head], raw: Tensor, labels: Tensor) -> Tensor:
    """What meta-training lowers, from raw outputs and labels (T, N, O) to (T,).

    The mean of losses that are logarithms, and the root of a mean squared error, so that a tenth of
    it gone counts the same at a fine object as at a poor one. The plain loss listens to tasks whose
    error cannot be lowered, and hardly to what is nearly right. Squared errors of heads that weigh
    the same and count in the same samples are those of one vector.
    """
    total = raw.new_zeros(raw.shape[0])
    squared: dict[tuple[float, int | None], Tensor] = {}
    for head, place in zip(heads, channels_of(heads), strict=True):
        some = slice(place.start, place.stop)
        value = LOSSES[head.kind].value(head, raw[..., some], labels[..., some])
        gate = labels.new_ones(value.shape) if head.where is None else labels[..., head.where]
        summed = (value * gate).sum(dim=1)
        if head.kind == "squared":
            mean = summed / gate.sum(dim=1).clamp(min=1.0)
            vector = head.weight, head.where
            squared[vector] = squared[vector] + mean if vector in squared else mean
        else:
            total = total + head.weight * (summed / value.shape[1])
    for (weight, _), mean in squared.items():
        total = total + weight * (mean + SMALLEST_ERROR).sqrt()
    return total


def _gated(head: Head, labels: Tensor, value: Tensor) -> Tensor:
    return value if head.where is None else labels[..., head.where] * value
