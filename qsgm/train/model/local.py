"""Layer-local training steps in torch, many tasks at once.

The same arithmetic as the exported step graphs, written so that torch can differentiate through
whole runs of it (meta-training) and serve as their oracle. Weights carry a leading task axis T,
so one matrix product advances every task. Convolutions are im2col followed by a product, with
weights stored as (kernel x kernel x in, out).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from qsgm.train.model.curvature import FLAT, Curvature
from qsgm.train.model.graspnet import KERNELS, LAYERS, POOL_AFTER_LAYER, STRIDES, Loss

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

    def detach(self) -> "LayerState":
        return LayerState(
            self.weight.detach(),
            self.bias.detach(),
            self.weight_momentum.detach(),
            self.bias_momentum.detach(),
        )


def im2col_index(side: int, kernel: int, stride: int) -> Tensor:
    """Positions (P_out, kernel * kernel) of a square map that each window of it covers."""
    start = torch.arange(0, side - kernel + 1, stride)
    base = (start[:, None] * side + start[None, :]).reshape(-1, 1)
    step = torch.arange(kernel)
    return base + (step[:, None] * side + step[None, :]).reshape(1, -1)


def columns(layer: int, x: Tensor) -> Tensor:
    """The windows (T, B, P_out, K) that a layer sees of its input (T, B, P, C_in)."""
    kernel = KERNELS[layer - 1]
    if kernel == 1:
        return x
    side = int(x.shape[2] ** 0.5)
    index = im2col_index(side, kernel, STRIDES[layer - 1])
    return x[:, :, index].flatten(3)


def layer_forward(layer: int, state: LayerState, col: Tensor) -> tuple[Tensor, Tensor]:
    """Pre-activation (T, B, P, C_out) and activation, pooled to one position after layer 4."""
    tasks, batch, positions, width = col.shape
    flat = torch.baddbmm(state.bias[:, None], col.reshape(tasks, -1, width), state.weight)
    before = flat.reshape(tasks, batch, positions, -1)
    if layer == LAYERS:
        return before, before
    after = torch.relu(before)
    return before, after.mean(dim=2, keepdim=True) if layer == POOL_AFTER_LAYER else after


def through_activation(layer: int, before: Tensor, gradient: Tensor) -> Tensor:
    """The gradient on a layer's activation carried back to its pre-activation."""
    if layer == LAYERS:
        return gradient
    if layer == POOL_AFTER_LAYER:
        gradient = gradient / before.shape[2]
    return gradient * (before > 0)


def weight_gradients(col: Tensor, dz: Tensor) -> tuple[Tensor, Tensor]:
    """Mean-over-batch gradients of weight (T, K, C_out) and bias (T, C_out)."""
    tasks, batch = col.shape[:2]
    flat_col, flat_dz = col.reshape(tasks, -1, col.shape[-1]), dz.reshape(tasks, -1, dz.shape[-1])
    return flat_col.transpose(1, 2) @ flat_dz / batch, flat_dz.sum(dim=1) / batch


def loss_gradient(loss: Loss, raw: Tensor, labels: Tensor) -> Tensor:
    """d loss / d raw outputs, per sample; (..., 3) each."""
    quality = torch.sigmoid(raw[..., :1]) - (
        labels[..., :1] * (1 - loss.label_smoothing) + loss.label_smoothing / 2
    )
    sine = torch.tanh(raw[..., 1:2])
    d_sine = (sine - labels[..., 1:2]) * (1 - sine.square())
    if loss.encoding == "double":
        cosine = torch.tanh(raw[..., 2:])
        d_cosine = (cosine - labels[..., 2:]) * (1 - cosine.square())
    else:
        cosine = torch.sigmoid(raw[..., 2:])
        d_cosine = (cosine - labels[..., 2:]) * cosine * (1 - cosine)
    angle = 2 * loss.angle_weight * labels[..., :1] * torch.cat([d_sine, d_cosine], dim=-1)
    return torch.cat([quality, angle], dim=-1)


def local_step(
    states: Sequence[LayerState],
    features: Tensor,
    labels: Tensor,
    rates: Sequence[Tensor],
    gradient_of: GradientOf,
    momentum: float,
    curvatures: Mapping[int, Curvature] = FLAT,
) -> list[LayerState]:
    """One feed-forward training step: every layer updates itself before the next one runs.

    Args:
        states: the tuned layers, in order; the last of them is layer 6.
        features: (T, B, P, C), input of the first tuned layer.
        labels: (T, B, 3).
        rates: one learning rate per layer, a scalar or one per task, (T,).
        gradient_of: where the gradient on an activation comes from (layer 6: the loss).
        momentum: of SGD.
        curvatures: by layer, where there is one.
    """
    updated, x = [], features
    for layer, state, rate in zip(_numbers(states), states, rates, strict=True):
        col = columns(layer, x)
        before, x = layer_forward(layer, state, col)
        dz = through_activation(layer, before, gradient_of(layer, x, labels))
        gradients = weight_gradients(col, dz)
        if layer in curvatures:
            gradients = curvatures[layer].bend(*gradients)
        updated.append(sgd(state, *gradients, rate, momentum))
    return updated


def sgd(
    state: LayerState, d_weight: Tensor, d_bias: Tensor, rate: Tensor, momentum: float
) -> LayerState:
    """SGD with momentum as torch has it (no dampening); the rate a scalar or (T,)."""
    weight_momentum = momentum * state.weight_momentum + d_weight
    bias_momentum = momentum * state.bias_momentum + d_bias
    return LayerState(
        state.weight - rate.view(-1, 1, 1) * weight_momentum,
        state.bias - rate.view(-1, 1) * bias_momentum,
        weight_momentum,
        bias_momentum,
    )


def outputs(states: Sequence[LayerState], features: Tensor) -> Tensor:
    """Raw outputs (T, B, 3) of the tuned layers."""
    x = features
    for layer, state in zip(_numbers(states), states, strict=True):
        _, x = layer_forward(layer, state, columns(layer, x))
    return x[:, :, 0]


def true_gradients(
    states: Sequence[LayerState], features: Tensor, labels: Tensor, loss: Loss
) -> dict[int, Tensor]:
    """Per-sample gradients on every tuned layer's activation by backpropagation, written out."""
    inputs, befores, x = {}, {}, features
    for layer, state in zip(_numbers(states), states, strict=True):
        inputs[layer] = x
        befores[layer], x = layer_forward(layer, state, columns(layer, x))
    gradients = {LAYERS: loss_gradient(loss, x, labels[:, :, None])}
    for layer, state in list(zip(_numbers(states), states, strict=True))[:0:-1]:
        dz = through_activation(layer, befores[layer], gradients[layer])
        d_columns = dz @ state.weight.transpose(1, 2)[:, None]
        gradients[layer - 1] = sum_windows(layer, d_columns, inputs[layer].shape[2])
    return gradients


def sum_windows(layer: int, windows: Tensor, positions: int) -> Tensor:
    """The transpose of :func:`columns`: windows (T, B, P_out, K) added up where they overlap.

    Returns (T, B, P, C_in) with P = `positions`, a square map.
    """
    kernel, side = KERNELS[layer - 1], round(positions**0.5)
    if kernel == 1:
        return windows
    by_channel = windows.unflatten(3, (kernel * kernel, -1)).flatten(0, 1).permute(0, 3, 2, 1)
    channels_first = by_channel.flatten(1, 2)
    maps = F.fold(channels_first, (side, side), kernel, stride=STRIDES[layer - 1])
    return maps.flatten(2).transpose(1, 2).reshape(*windows.shape[:2], positions, -1)


def _numbers(states: Sequence[LayerState]) -> range:
    return range(LAYERS - len(states) + 1, LAYERS + 1)
