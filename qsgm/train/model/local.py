"""Layer-local training steps in torch, many tasks at once.

The same arithmetic as the exported step graphs, written so that torch can differentiate through
whole runs of it (meta-training) and serve as their oracle. Weights carry a leading task axis T,
so one matrix product advances every task. Convolutions are im2col followed by a product, with
weights stored as (kernel x kernel x in, out).
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from qsgm.network import ONE, Network, Pair
from qsgm.schedule import MOMENTUM
from qsgm.task import Heads
from qsgm.train import heads as losses
from qsgm.train.model.curvature import FLAT, Curvature

# (layer, activation (T, B, P, C), labels (T, B, 3)) -> gradient of each sample's loss, same shape
GradientOf = Callable[[int, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class LayerState:
    """A tuned layer's weights and their momenta."""

    weight: Tensor  # (T, K, C_out), K = kernel * kernel * C_in
    bias: Tensor  # (T, C_out)
    weight_momentum: Tensor
    bias_momentum: Tensor

    @staticmethod
    def start(weight: Tensor, bias: Tensor) -> "LayerState":
        return LayerState(weight, bias, torch.zeros_like(weight), torch.zeros_like(bias))

    @staticmethod
    def joined(states: "Sequence[LayerState]") -> "LayerState":
        """Several ones side by side on the task axis."""
        return LayerState(*(torch.cat(some) for some in zip(*map(_tensors, states), strict=True)))

    def of_task(self, i: int) -> "LayerState":
        """One task's part, without its history."""
        return LayerState(*(one[i : i + 1].detach() for one in _tensors(self)))


def _tensors(state: LayerState) -> tuple[Tensor, ...]:
    return state.weight, state.bias, state.weight_momentum, state.bias_momentum


def window_index(side: Pair, kernel: Pair, stride: Pair) -> Tensor:
    """Positions (P_out, kh * kw) of a map of this size that each window of it covers."""
    (height, width), (tall, wide) = side, kernel
    rows = torch.arange(0, height - tall + 1, stride[0])
    columns = torch.arange(0, width - wide + 1, stride[1])
    base = (rows[:, None] * width + columns[None, :]).reshape(-1, 1)
    steps = torch.arange(tall)[:, None] * width + torch.arange(wide)[None, :]
    return base + steps.reshape(1, -1)


def columns(network: Network, number: int, x: Tensor) -> Tensor:
    """The windows (T, B, P_out, K) that a layer sees of its input (T, B, P, C_in)."""
    layer, (height, width) = network.layer(number), network.before(number)
    if (layer.kernel, layer.stride, layer.padding) == (ONE, ONE, (0, 0)):
        return x
    up, left = layer.padding
    if up or left:
        x = F.pad(x.unflatten(2, (height, width)), (0, 0, left, left, up, up)).flatten(2, 3)
    maps = x.unflatten(2, (height + 2 * up, width + 2 * left))
    rows = maps.unfold(2, layer.kernel[0], layer.stride[0])
    windows = rows.unfold(3, layer.kernel[1], layer.stride[1])  # (T, B, H', W', C, kh, kw)
    # Copied by a window's rows: to pick position by position takes 2 to 6 times as long.
    copied: Tensor = windows.permute(0, 1, 2, 3, 5, 6, 4).flatten(4)
    return copied.flatten(2, 3)


def layer_forward(
    network: Network, number: int, state: LayerState, col: Tensor
) -> tuple[Tensor, Tensor]:
    """Pre-activation (T, B, P, C_out) and activation, behind ReLU and pool."""
    layer = network.layer(number)
    tasks, batch, positions, width = col.shape
    flat = torch.baddbmm(state.bias[:, None], col.reshape(tasks, -1, width), state.weight)
    before = flat.reshape(tasks, batch, positions, -1)
    after = torch.relu(before) if layer.relu else before
    if layer.pool == ONE:
        return before, after
    if network.pools_all(number):
        return before, after.mean(dim=2, keepdim=True)
    return before, after[:, :, pool_index(network, number)].mean(dim=3)


def pool_index(network: Network, number: int) -> Tensor:
    """Positions (P', kh * kw) of a layer's convolved map that each window of its pool covers."""
    layer = network.layer(number)
    return window_index(network.convolved(number), layer.pool, layer.pool_stride)


def through_activation(network: Network, number: int, before: Tensor, gradient: Tensor) -> Tensor:
    """The gradient on a layer's activation carried back to its pre-activation."""
    layer = network.layer(number)
    if network.pools_all(number):
        gradient = (gradient / before.shape[2]).expand_as(before)
    elif layer.pool != ONE:
        index = pool_index(network, number)
        share = (gradient / index.shape[1])[:, :, :, None].expand(-1, -1, -1, index.shape[1], -1)
        gradient = torch.zeros_like(before).index_add(2, index.flatten(), share.flatten(2, 3))
    return gradient * (before > 0) if layer.relu else gradient


def weight_gradients(col: Tensor, dz: Tensor) -> tuple[Tensor, Tensor]:
    """Mean-over-batch gradients of weight (T, K, C_out) and bias (T, C_out)."""
    tasks, batch = col.shape[:2]
    flat_col, flat_dz = col.reshape(tasks, -1, col.shape[-1]), dz.reshape(tasks, -1, dz.shape[-1])
    return flat_col.transpose(1, 2) @ flat_dz / batch, flat_dz.sum(dim=1) / batch


def local_step(
    network: Network,
    states: Sequence[LayerState],
    features: Tensor,
    labels: Tensor,
    rates: Sequence[Tensor],
    gradient_of: GradientOf,
    curvatures: Mapping[int, Curvature] = FLAT,
) -> list[LayerState]:
    """One feed-forward training step: every layer updates itself before the next one runs.

    Args:
        network: whose last layers these are.
        states: the tuned layers, in order.
        features: (T, B, P, C), input of the first tuned layer.
        labels: (T, B, L).
        rates: one learning rate per layer, a scalar or one per task, (T,).
        gradient_of: where the gradient on an activation comes from (the last one: the loss).
        curvatures: by layer, where there is one.
    """
    given = local_gradients(network, states, features, labels, gradient_of, curvatures)
    return [
        sgd(state, *gradients, rate)
        for state, gradients, rate in zip(states, given, rates, strict=True)
    ]


def local_gradients(
    network: Network,
    states: Sequence[LayerState],
    features: Tensor,
    labels: Tensor,
    gradient_of: GradientOf,
    curvatures: Mapping[int, Curvature] = FLAT,
) -> Iterator[tuple[Tensor, Tensor]]:
    """Every layer's gradients of weight and bias, one layer after the other.

    Arguments are those of :func:`local_step`.
    """
    x = features
    for layer, state in zip(network.last(len(states)), states, strict=True):
        col = columns(network, layer, x)
        before, x = layer_forward(network, layer, state, col)
        dz = through_activation(network, layer, before, gradient_of(layer, x, labels))
        gradients = weight_gradients(col, dz)
        yield curvatures[layer].precondition(*gradients) if layer in curvatures else gradients


def sgd(state: LayerState, d_weight: Tensor, d_bias: Tensor, rate: Tensor) -> LayerState:
    """SGD with momentum as torch has it (no dampening); the rate a scalar or (T,)."""
    weight_momentum = MOMENTUM * state.weight_momentum + d_weight
    bias_momentum = MOMENTUM * state.bias_momentum + d_bias
    return LayerState(
        state.weight - rate.view(-1, 1, 1) * weight_momentum,
        state.bias - rate.view(-1, 1) * bias_momentum,
        weight_momentum,
        bias_momentum,
    )


def outputs(network: Network, states: Sequence[LayerState], features: Tensor) -> Tensor:
    """Raw outputs (T, B, O) of the tuned layers, whose last one has one position."""
    x = features
    for layer, state in zip(network.last(len(states)), states, strict=True):
        _, x = layer_forward(network, layer, state, columns(network, layer, x))
    return x[:, :, 0]


def true_gradients(
    network: Network,
    states: Sequence[LayerState],
    features: Tensor,
    labels: Tensor,
    heads: Heads,
) -> dict[int, Tensor]:
    """Per-sample gradients on every tuned layer's activation by backpropagation, written out."""

    def error(_: int, raw: Tensor, known: Tensor) -> Tensor:
        return losses.error(heads, raw, known[:, :, None])

    whole = (network.last(len(states)),)
    return group_gradients(network, whole, states, features, labels, error)


def group_gradients(
    network: Network,
    groups: Sequence[range],
    states: Sequence[LayerState],
    features: Tensor,
    labels: Tensor,
    gradient_of: GradientOf,
) -> dict[int, Tensor]:
    """Per-sample gradients on every tuned layer's activation, carried back inside of each group.

    On the activation of a group's last layer it is what `gradient_of` gives.
    """
    of_layer = dict(zip(network.last(len(states)), states, strict=True))
    gradients, x = dict[int, Tensor](), features
    for group in groups:
        befores = {}
        for layer in group:
            col = columns(network, layer, x)
            befores[layer], x = layer_forward(network, layer, of_layer[layer], col)
        gradients[group[-1]] = gradient_of(group[-1], x, labels)
        for layer in group[:0:-1]:
            weight, before = of_layer[layer].weight, befores[layer]
            gradients[layer - 1] = to_input(network, layer, weight, before, gradients[layer])
    return gradients


def to_input(
    network: Network, number: int, weight: Tensor, before: Tensor, gradient: Tensor
) -> Tensor:
    """The gradient on a layer's activation carried back to its input by (T, K, C) or (K, C)."""
    dz = through_activation(network, number, before, gradient)
    return sum_windows(network, number, dz @ weight.transpose(-1, -2).unsqueeze(-3))


def sum_windows(network: Network, number: int, windows: Tensor) -> Tensor:
    """The transpose of :func:`columns`: windows (T, B, P_out, K) added up where they overlap.

    Returns (T, B, P, C_in).
    """
    layer, side = network.layer(number), network.before(number)
    if (layer.kernel, layer.stride, layer.padding) == (ONE, ONE, (0, 0)):
        return windows
    taps = layer.kernel[0] * layer.kernel[1]
    by_channel = windows.unflatten(3, (taps, -1)).flatten(0, 1).permute(0, 3, 2, 1)
    maps = F.fold(
        by_channel.flatten(1, 2), side, layer.kernel, padding=layer.padding, stride=layer.stride
    )
    return maps.flatten(2).transpose(1, 2).reshape(*windows.shape[:2], maps[0, 0].numel(), -1)
