"""Fold batchnorm, and the pixel normalisation, into the convolutions in front of them.

Batchnorm with running statistics is an affine map per channel, so a convolution can absorb it.
The network's first layer also absorbs x / 127.5 - 1: it has no padding, so every window sees the
same offset and the folded network takes raw pixels. Sums are done in float64, results are float32.

Contract. Before: every batchnorm stands right behind a convolution and has finite running
statistics with a positive variance. After: convolutions, biases, ReLU and pooling, nothing else.
"""

import copy
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from qsgm.errors import QsgmError
from qsgm.train.graspnet import POOL, GraspNet, Layer, normalize
from qsgm.train.sgm import Sgm

FloatArray = NDArray[np.float32]

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
    """The six layers; the first takes raw BGR pixel values, 0 to 255."""

    layers: tuple[FoldedLayer, ...]


@dataclass(frozen=True)
class FoldedSgm:
    """The SGM behind layer `layer`: convolution, ReLU, convolution; padded to keep the size."""

    layer: int
    conv1_weight: FloatArray  # (H, Ci, k, k)
    conv1_bias: FloatArray  # (H,)
    conv2_weight: FloatArray  # (C, H, k, k)
    conv2_bias: FloatArray  # (C,)

    @property
    def extra_channels(self) -> int:
        """Input channels beside the activation: 3 (label) or 6 (label and last error)."""
        return int(self.conv1_weight.shape[1] - self.conv2_weight.shape[0])


def fold_net(net: GraspNet) -> FoldedNet:
    """Fold batchnorm and pixel normalisation. Raises QsgmError where the contract is broken."""
    layers = [layer for layer in net.layers if isinstance(layer, Layer)]
    refuse_other_norms(net, (layer.norm for layer in layers))
    return FoldedNet(tuple(fold_layer(number, layer) for number, layer in enumerate(layers, 1)))


def fold_layer(number: int, layer: Layer) -> FoldedLayer:
    """One layer, numbered from 1; the first absorbs the pixel normalisation as well."""
    weight, bias = as_float64(layer.conv)
    if number == 1:
        weight, bias = absorb_input_affine(weight, bias, PIXEL_SCALE, PIXEL_OFFSET)
    if layer.norm is not None:
        weight, bias = absorb_norm(weight, bias, layer.norm, f"layer {number}")
    return FoldedLayer(
        *as_float32(f"layer {number}", weight, bias),
        stride=layer.conv.stride[0],
        relu=layer.norm is not None,
        pool=1 if layer.pool is None else POOL,
    )


def fold_sgm(layer: int, sgm: Sgm) -> FoldedSgm:
    """Fold the batchnorm of the SGM behind `layer`. Raises QsgmError as :func:`fold_net` does."""
    where = f"the SGM behind layer {layer}"
    refuse_other_norms(sgm, [sgm.norm])
    first = absorb_norm(*as_float64(sgm.conv1), sgm.norm, where)
    second = as_float64(sgm.conv2)
    folded = FoldedSgm(layer, *as_float32(where, *first), *as_float32(where, *second))
    if folded.extra_channels not in (3, 6):
        raise QsgmError(
            f"{where} has {folded.extra_channels} input channels beside the activation: expected 3"
            " (label) or 6 (label and last error); pretrain it again with this version"
        )
    return folded


def net_fold_error(net: GraspNet, folded: FoldedNet, crops: Tensor) -> float:
    """Largest |difference| of raw outputs before and after folding; crops uint8 (N, H, W, 3)."""
    with torch.no_grad():
        before = copy.deepcopy(net).eval()(normalize(crops))
        after = run_folded(folded, crops)
    return float((before - after).abs().max())


def sgm_fold_error(sgm: Sgm, folded: FoldedSgm, inputs: Tensor) -> float:
    """Largest |difference| of gradients before and after folding; inputs (N, Ci, H, W)."""
    original = copy.deepcopy(sgm).eval()
    with torch.no_grad():
        before = original.conv2(F.relu(original.norm(original.conv1(inputs))))
        after = run_folded_sgm(folded, inputs)
    return float((before - after).abs().max())


def run_folded(folded: FoldedNet, crops: Tensor) -> Tensor:
    """Raw outputs (N, 3, rows, cols) of the folded network on pixels (N, H, W, 3)."""
    x = crops.permute(0, 3, 1, 2).float()
    for layer in folded.layers:
        x = F.conv2d(x, torch.tensor(layer.weight), torch.tensor(layer.bias), layer.stride)
        x = F.relu(x) if layer.relu else x
        x = F.avg_pool2d(x, layer.pool, stride=1)
    return x


def run_folded_sgm(folded: FoldedSgm, inputs: Tensor) -> Tensor:
    """Gradients (N, C, H, W) from the concatenated inputs (N, Ci, H, W)."""
    pad = folded.conv1_weight.shape[2] // 2
    weight1, bias1 = torch.tensor(folded.conv1_weight), torch.tensor(folded.conv1_bias)
    weight2, bias2 = torch.tensor(folded.conv2_weight), torch.tensor(folded.conv2_bias)
    hidden = F.relu(F.conv2d(inputs, weight1, bias1, padding=pad))
    return F.conv2d(hidden, weight2, bias2, padding=pad)


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


def absorb_input_affine(
    weight: Tensor, bias: Tensor, scale: float, offset: float
) -> tuple[Tensor, Tensor]:
    """The convolution that does to x what the given one does to scale * x + offset (no padding)."""
    return weight * scale, bias + offset * weight.sum(dim=(1, 2, 3))


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
