"""Fold batchnorm into the convolutions in front of it.

Batchnorm with running statistics is an affine map per channel, so a convolution can absorb it.
Where the first layer is frozen it can absorb x / 127.5 - 1 as well (:func:`on_pixels`): it has no
padding, so every window sees the same offset. Tuned it sees pixels in [-1, 1], as in pretraining:
the same rate means other steps on raw pixels. Sums are done in float64, results are float32.

Contract. Before: every batchnorm stands right behind a convolution and has finite running
statistics with a positive variance. After: convolutions, biases, ReLU and pooling, nothing else.
"""

import copy
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from qsgm.errors import QsgmError
from qsgm.sgm.float import FloatArray, FoldedConv, FoldedSgm
from qsgm.train.model.graspnet import POOL, GraspNet, Layer, normalize
from qsgm.train.model.sgm import Sgm

PIXEL_SCALE = 1 / 127.5
PIXEL_OFFSET = -1.0


@dataclass(frozen=True)
class FoldedLayer:
    """A convolution without padding, then ReLU and an average pool of stride 1 where set."""

    weight: FloatArray  # (Co, Ci, kh, kw)
    bias: FloatArray  # (Co,)
    stride: int
    relu: bool
    pool: int  # side of the pooling window; 1: none


@dataclass(frozen=True)
class FoldedNet:
    """The six layers; the first takes BGR pixels in [-1, 1], see :func:`on_pixels`."""

    layers: tuple[FoldedLayer, ...]
    # By layer, (Co,): what one step of each channel stands for where its output is kept in u8, see
    # :mod:`qsgm.train.quantization.trunk`. Features of a layer that is not here are float32.
    feature_steps: Mapping[int, FloatArray] = field(default_factory=dict)


def fold_net(net: GraspNet) -> FoldedNet:
    """Fold batchnorm. Raises QsgmError where the contract is broken."""
    layers = [layer for layer in net.layers if isinstance(layer, Layer)]
    refuse_other_norms(net, (layer.norm for layer in layers))
    return FoldedNet(tuple(fold_layer(number, layer) for number, layer in enumerate(layers, 1)))


def fold_layer(number: int, layer: Layer) -> FoldedLayer:
    """One layer, numbered from 1."""
    weight, bias = as_float64(layer.conv)
    if layer.norm is not None:
        weight, bias = absorb_norm(weight, bias, layer.norm, f"layer {number}")
    return FoldedLayer(
        *as_float32(f"layer {number}", weight, bias),
        stride=layer.conv.stride[0],
        relu=layer.norm is not None,
        pool=1 if layer.pool is None else POOL,
    )


def on_pixels(net: FoldedNet) -> FoldedNet:
    """The same network on raw BGR pixel values, 0 to 255: the first layer normalises them."""
    first = net.layers[0]
    weight = first.weight.astype(np.float64)
    bias = first.bias + PIXEL_OFFSET * weight.sum(axis=(1, 2, 3))
    absorbed = replace(
        first,
        weight=(weight * PIXEL_SCALE).astype(np.float32),
        bias=bias.astype(np.float32),
    )
    return replace(net, layers=(absorbed, *net.layers[1:]))


def fold_sgm(sgm: Sgm) -> FoldedSgm:
    """Fold an SGM's batchnorms. Raises QsgmError as :func:`fold_net` does."""
    where = f"the SGM behind layer {sgm.layer}"
    refuse_other_norms(sgm, sgm.norms)
    folded = [as_float64(conv) for conv in convolutions(sgm)]
    for i, norm in enumerate(batchnorms(sgm)):
        folded[i] = absorb_norm(*folded[i], norm, where)
    return FoldedSgm(sgm.layer, tuple(FoldedConv(*as_float32(where, *conv)) for conv in folded))


def net_fold_error(net: GraspNet, folded: FoldedNet, crops: Tensor) -> float:
    """Largest |difference| of raw outputs before and after folding; crops uint8 (N, H, W, 3)."""
    with torch.no_grad():
        before = copy.deepcopy(net).eval()(normalize(crops))
        after = run_folded(folded, crops)
    return float((before - after).abs().max())


def sgm_fold_error(sgm: Sgm, folded: FoldedSgm, activation: Tensor, labels: Tensor) -> float:
    """Largest |difference| of gradients before and after folding.

    Args:
        sgm: as trained.
        folded: what :func:`fold_sgm` made of it.
        activation: (N, C, H, W).
        labels: (N, 3).
    """
    with torch.no_grad():
        before = copy.deepcopy(sgm).eval()(activation, labels)
        after = run_folded_sgm(folded, activation, labels)
    return float((before - after).abs().max())


def run_folded(folded: FoldedNet, crops: Tensor) -> Tensor:
    """Raw outputs (N, 3, rows, cols) of the folded network on pixels (N, H, W, 3)."""
    x = normalize(crops)
    for layer in folded.layers:
        x = F.conv2d(x, torch.tensor(layer.weight), torch.tensor(layer.bias), layer.stride)
        x = F.relu(x) if layer.relu else x
        x = F.avg_pool2d(x, layer.pool, stride=1)
    return x


def run_folded_sgm(folded: FoldedSgm, activation: Tensor, labels: Tensor) -> Tensor:
    """Activation (N, C, H, W) and labels (N, 3) to gradients (N, C, H, W)."""
    filled = labels[:, :, None, None].expand(-1, -1, *activation.shape[2:])
    x = torch.cat([activation, filled], dim=1)
    for conv in folded.convs[:-1]:
        x = F.relu(run_folded_conv(conv, x))
    return run_folded_conv(folded.convs[-1], x)


def run_folded_conv(conv: FoldedConv, x: Tensor) -> Tensor:
    """x (N, I, H, W) to (N, O, H, W)."""
    pad = conv.weight.shape[2] // 2
    return F.conv2d(x, torch.tensor(conv.weight), torch.tensor(conv.bias), padding=pad)


def convolutions(sgm: Sgm) -> list[nn.Conv2d]:
    """An SGM's convolutions, in order."""
    return [conv for conv in sgm.convs if isinstance(conv, nn.Conv2d)]


def batchnorms(sgm: Sgm) -> list[nn.BatchNorm2d]:
    """An SGM's batchnorms, one behind every convolution but the last."""
    return [norm for norm in sgm.norms if isinstance(norm, nn.BatchNorm2d)]


def as_float64(conv: nn.Conv2d) -> tuple[Tensor, Tensor]:
    """Weight and bias; a convolution without bias has zeros."""
    weight = conv.weight.detach().cpu().double()
    bias = weight.new_zeros(len(weight)) if conv.bias is None else conv.bias.detach().cpu().double()
    return weight, bias


def as_float32(where: str, weight: Tensor, bias: Tensor) -> tuple[FloatArray, FloatArray]:
    """Numpy copies. Raises QsgmError unless every value is finite."""
    if not (weight.isfinite().all() and bias.isfinite().all()):
        raise QsgmError(
            f"{where} has weights that are not finite: training diverged; pretrain again with"
            " a smaller learning rate"
        )
    return weight.float().numpy(), bias.float().numpy()


def absorb_norm(
    weight: Tensor, bias: Tensor, norm: nn.BatchNorm2d, where: str
) -> tuple[Tensor, Tensor]:
    """The convolution that equals the given one followed by `norm` with running statistics."""
    mean, variance = norm.running_mean, norm.running_var
    if mean is None or variance is None:
        raise QsgmError(f"{where}: batchnorm keeps no running statistics, there is none to fold")
    if not (mean.isfinite().all() and variance.isfinite().all() and (variance > 0).all()):
        raise QsgmError(
            f"{where}: batchnorm's running statistics must be finite and the variance positive,"
            f" got variances down to {float(variance.min()):g}; pretrain again"
        )
    gain = norm.weight.detach().cpu().double() / (variance.cpu().double() + norm.eps).sqrt()
    shift = norm.bias.detach().cpu().double() - mean.cpu().double() * gain
    return weight * gain[:, None, None, None], bias * gain + shift


def refuse_other_norms(module: nn.Module, folded: Iterable[nn.Module | None]) -> None:
    """Raise QsgmError if `module` holds a batchnorm that is not among those to be folded."""
    known = {id(norm) for norm in folded}
    for name, child in module.named_modules():
        if isinstance(child, nn.modules.batchnorm._BatchNorm) and id(child) not in known:
            raise QsgmError(
                f"batchnorm {name!r} does not stand behind a convolution of its own:"
                " it cannot be folded; use the network as this version builds it"
            )
