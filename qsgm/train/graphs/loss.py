"""The loss in a graph: output activation, value, and the error that starts every gradient."""

from qsgm.grasp.angles import AngleEncoding
from qsgm.train.graphs.build import Ops, Value
from qsgm.train.model.graspnet import Loss


def channels(op: Ops, x: Value, start: int, stop: int) -> Value:
    """Channels `start` to `stop` of (B, C, ...)."""
    return op.Slice(x, op.shape(start), op.shape(stop), op.shape(1))


def activate(op: Ops, raw: Value, encoding: AngleEncoding) -> tuple[Value, Value]:
    """Raw outputs (B, 3, ...) to quality in (0, 1), (B, 1, ...), and sine, cosine (B, 2, ...)."""
    return op.Sigmoid(channels(op, raw, 0, 1)), turned(op, channels(op, raw, 1, 3), encoding)


def turned(op: Ops, raw: Value, encoding: AngleEncoding) -> Value:
    """Raw outputs (B, 2, ...) of the angle to its sine and cosine."""
    if encoding == "double":
        return op.Tanh(raw)
    return op.Concat(op.Tanh(channels(op, raw, 0, 1)), op.Sigmoid(channels(op, raw, 1, 2)), axis=1)


def angle_slope(op: Ops, angle: Value, encoding: AngleEncoding) -> Value:
    """Derivative (B, 2) of the activated sine and cosine by their raw outputs."""
    one = op.constant(1.0)
    if encoding == "double":
        return op.Sub(one, op.Mul(angle, angle))
    sine, cosine = channels(op, angle, 0, 1), channels(op, angle, 1, 2)
    slopes = op.Sub(one, op.Mul(sine, sine)), op.Mul(cosine, op.Sub(one, cosine))
    return op.Concat(*slopes, axis=1)


def loss_and_error(op: Ops, loss: Loss, raw: Value, labels: Value) -> tuple[Value, Value]:
    """Mean loss, a scalar, and each sample's d loss / d raw outputs (B, 3); both inputs (B, 3)."""
    # Each slice is taken once: the runtime then makes one node of those of a tensor.
    logit, raw_angle = channels(op, raw, 0, 1), channels(op, raw, 1, 3)
    label, direction = channels(op, labels, 0, 1), channels(op, labels, 1, 3)
    smoothing = loss.label_smoothing
    target = op.Add(op.Mul(label, op.constant(1 - smoothing)), op.constant(smoothing / 2))
    angle = turned(op, raw_angle, loss.encoding)
    miss = op.Sub(angle, direction)
    # The derivative of the angle's loss by the angle; negatives have none.
    pull = op.Mul(op.Mul(label, op.constant(2 * loss.angle_weight)), miss)

    log_loss = op.Sub(op.Softplus(logit), op.Mul(target, logit))
    # Half of pull * miss, summed over sine and cosine, is their mean.
    means = (op.ReduceMean(x, keepdims=0) for x in (log_loss, op.Mul(pull, miss)))

    logit_error = op.Sub(op.Sigmoid(logit), target)
    angle_error = op.Mul(pull, angle_slope(op, angle, loss.encoding))
    return op.Add(*means), op.Concat(logit_error, angle_error, axis=1)
