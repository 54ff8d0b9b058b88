"""All heads' losses in a graph: output activation, value, the error that gradients start with."""

from collections.abc import Sequence

from qsgm.task import Head, channels_of
from qsgm.train.graphs.build import Ops, Value
from qsgm.train.heads import LOSSES


def channels(op: Ops, x: Value, some: range) -> Value:
    """Slice of the channels of (B, C, ...)."""
    return op.Slice(x, op.shape(some.start), op.shape(some.stop), op.shape(1))


def activate(op: Ops, heads: Sequence[Head], raw: Value) -> Value:
    """Raw outputs (B, O, ...) as the user sees them."""
    parts = [
        LOSSES[head.kind].graph_activate(op, head, channels(op, raw, place))
        for head, place in zip(heads, channels_of(heads), strict=True)
    ]
    return op.Concat(*parts, axis=1) if len(parts) > 1 else parts[0]


def loss_and_error(
    op: Ops, heads: Sequence[Head], raw: Value, labels: Value
) -> tuple[Value, Value]:
    """Mean loss, a scalar, and each sample's d loss / d raw outputs (B, O); both inputs (B, O)."""
    means, errors = [], []
    places = channels_of(heads)
    # Each slice is taken once: the runtime then makes one node of those of a tensor.
    known = {place: channels(op, labels, place) for place in places}
    for head, place in zip(heads, places, strict=True):
        gate = None
        if head.where is not None:
            one = range(head.where, head.where + 1)
            gate = known[one] if one in known else channels(op, labels, one)
        loss = LOSSES[head.kind]
        mean, error = loss.graph(op, head, channels(op, raw, place), known[place], gate)
        means.append(mean)
        errors.append(error)
    total = means[0]
    for mean in means[1:]:
        total = op.Add(total, mean)
    return total, op.Concat(*errors, axis=1) if len(errors) > 1 else errors[0]
