"""The loss in a graph: output activation, value, and the error that starts every gradient."""

from qsgm.angles import AngleEncoding
from qsgm.train.graphs.build import Ops, Value
from qsgm.train.graspnet import Loss


def channels(op: Ops, x: Value, start: int, stop: int) -> Value:
    """Channels `start` to `stop` of (B, C, ...)."""
    return op.Slice(x, op.shape(start), op.shape(stop), op.shape(1))


def activate(op: Ops, raw: Value, encoding: AngleEncoding) -> tuple[Value, Value]:
    """Raw outputs (B, 3, ...) to quality in (0, 1), (B, 1, ...), and sine, cosine (B, 2, ...)."""
    quality = op.Sigmoid(channels(op, raw, 0, 1))
    if encoding == "double":
        return quality, op.Tanh(channels(op, raw, 1, 3))
    sine, cosine = op.Tanh(channels(op, raw, 1, 2)), op.Sigmoid(channels(op, raw, 2, 3))
    return quality, op.Concat(sine, cosine, axis=1)


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
    label, smoothing = channels(op, labels, 0, 1), loss.label_smoothing
    target = op.Add(op.Mul(label, op.constant(1 - smoothing)), op.constant(smoothing / 2))
    quality, angle = activate(op, raw, loss.encoding)
    miss = op.Sub(angle, channels(op, labels, 1, 3))
    weight = op.Mul(label, op.constant(loss.angle_weight))  # of the angle; negatives have none

    logit = channels(op, raw, 0, 1)
    log_loss = op.Sub(op.Softplus(logit), op.Mul(target, logit))
    squared = op.ReduceSum(op.Mul(miss, miss), op.shape(1), keepdims=1)
    mean = op.ReduceMean(op.Add(log_loss, op.Mul(weight, squared)), keepdims=0)

    angle_error = op.Mul(op.Mul(op.constant(2.0), miss), angle_slope(op, angle, loss.encoding))
    error = op.Concat(op.Sub(quality, target), op.Mul(weight, angle_error), axis=1)
    return mean, error
