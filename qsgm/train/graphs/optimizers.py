"""Optimizers in a graph: one parameter's update at a time.

An optimizer names the moments it keeps of every parameter, all of which start at zero, and makes
the rule that updates one parameter. Whatever the steps share is declared once, by `rule`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from onnx import TensorProto

from qsgm.manifest import OptimizerName
from qsgm.schedule import MOMENTUM
from qsgm.train.graphs.build import Graph, Ops, Product, Value

Gradient = Product | Value
# (operators, value, its moments, gradient, rate) -> next value, next moments
Rule = Callable[[Ops, Value, Sequence[Value], Gradient, Value], tuple[Value, Sequence[Value]]]


class Optimizer(Protocol):
    """What a step graph asks of its optimizer."""

    @property
    def moments(self) -> tuple[str, ...]:
        """What is kept of each parameter, as in `weight_<moment>4`."""
        ...

    @property
    def rate(self) -> float:
        """The usual one, for true gradients and every layer."""
        ...

    @property
    def sgm_rate(self) -> float | None:
        """The usual one for SGMs' gradients; None: those that were meta-trained."""
        ...

    def rule(self, graph: Graph) -> Rule:
        """Declare what all parameters share, and return the update of one of them."""
        ...


@dataclass(frozen=True)
class Sgd:
    """SGD with momentum, without dampening, as torch has it."""

    momentum: float = MOMENTUM
    rate: float = 1e-2
    sgm_rate: float | None = None

    @property
    def moments(self) -> tuple[str, ...]:
        return ("momentum",)

    def rule(self, graph: Graph) -> Rule:  # noqa: ARG002
        def update(
            op: Ops, value: Value, moments: Sequence[Value], gradient: Gradient, rate: Value
        ) -> tuple[Value, Sequence[Value]]:
            momentum = plus(op, gradient, moments[0], self.momentum)
            return op.Sub(value, op.Mul(rate, momentum)), (momentum,)

        return update


@dataclass(frozen=True)
class Adam:
    """Adam as torch has it.

    One more state, the scalar `step`, counts the steps done so far. It is float32 and starts at
    zero like every other state; it stays exact for 16 million steps.
    """

    mean_decay: float = 0.9
    square_decay: float = 0.999
    epsilon: float = 1e-8
    rate: float = 1e-3
    sgm_rate: float | None = 2e-3

    @property
    def moments(self) -> tuple[str, ...]:
        return ("mean", "square")

    def rule(self, graph: Graph) -> Rule:
        op = graph.within("adam")
        step = op.Add(graph.input("step", np.float32, ()), op.constant(1.0))
        graph.output("step_next", step, np.float32, ())
        mean_correction = _correction(op, self.mean_decay, step)
        square_correction = op.Sqrt(_correction(op, self.square_decay, step))

        def update(
            op: Ops, value: Value, moments: Sequence[Value], gradient: Gradient, rate: Value
        ) -> tuple[Value, Sequence[Value]]:
            new = value_of(op, gradient)
            mean = _decayed(op, moments[0], new, self.mean_decay)
            square = _decayed(op, moments[1], op.Mul(new, new), self.square_decay)
            root = op.Div(op.Sqrt(square), square_correction)
            direction = op.Div(mean, op.Add(root, op.constant(self.epsilon)))
            step_size = op.Div(rate, mean_correction)
            return op.Sub(value, op.Mul(step_size, direction)), (mean, square)

        return update


def value_of(op: Ops, gradient: Gradient) -> Value:
    """The gradient itself."""
    return gradient.alone(op) if isinstance(gradient, Product) else gradient


def plus(op: Ops, gradient: Gradient, other: Value, factor: float) -> Value:
    """The gradient plus `factor` times a value of its shape."""
    if isinstance(gradient, Product):
        return gradient.plus(op, other, factor)
    return op.Add(other if factor == 1 else op.Mul(other, op.constant(factor)), gradient)


def _decayed(op: Ops, moment: Value, new: Value, decay: float) -> Value:
    """The running average after one more value."""
    return op.Add(op.Mul(moment, op.constant(decay)), op.Mul(new, op.constant(1 - decay)))


def _correction(op: Ops, decay: float, step: Value) -> Value:
    """1 - decay^step, a float32 scalar: what a running average that began at zero has to gain."""
    # In double: in float32, 1 - 0.999 is already wrong in its fourth digit.
    power = op.Pow(op.constant(decay, np.float64), op.Cast(step, to=TensorProto.DOUBLE))
    return op.Cast(op.Sub(op.constant(1.0, np.float64), power), to=TensorProto.FLOAT)


# What bundles are exported with.
OPTIMIZERS: Mapping[OptimizerName, Optimizer] = {"sgd": Sgd(), "adam": Adam()}
