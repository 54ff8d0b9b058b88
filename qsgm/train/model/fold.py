"""Fold batchnorm into the convolutions in front of it, and write folded weights back.

Batchnorm with running statistics is an affine map per channel, so a convolution can absorb it. Sums
are done in float64, results are float32.

Contract. Before: every batchnorm stands right behind a convolution and has finite running
statistics with a positive variance. After: convolutions, biases, ReLU and pooling, nothing else.

The device trains folded weights, so meta-training has to as well. What it learns is written back
in front of the batchnorm it was folded with, which is what `sgm.pt` keeps.
"""

import copy
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from qsgm.errors import QsgmError
from qsgm.sgm.float import FloatArray, FoldedConv, FoldedSgm
from qsgm.train.model.arrays import FoldedNet
from qsgm.train.model.net import ConvLayer, ConvNet, as_seen
from qsgm.train.model.sgm import Sgm


def fold_net(net: ConvNet) -> FoldedNet:
    """Fold batchnorm. Raises QsgmError where the contract is broken."""
    layers = conv_layers(net)
    refuse_other_norms(net, (layer.norm for layer in layers))
    folded = (fold_layer(number, layer) for number, layer in enumerate(layers, 1))
    return FoldedNet(net.network, tuple(folded))


def fold_layer(number: int, layer: ConvLayer) -> FoldedConv:
    """One layer, numbered from 1."""
    weight, bias = as_float64(layer.conv)
    if layer.norm is not None:
        weight, bias = absorb_norm(weight, bias, layer.norm, f"layer {number}")
    return FoldedConv(*as_float32(f"layer {number}", weight, bias))


def fold_sgm(sgm: Sgm) -> FoldedSgm:
    """Fold an SGM's batchnorms. Raises QsgmError as :func:`fold_net` does."""
    where = f"the SGM behind layer {sgm.layer}"
    refuse_other_norms(sgm, sgm.norms)
    folded = [as_float64(conv) for conv in convolutions(sgm)]
    for i, norm in enumerate(batchnorms(sgm)):
        folded[i] = absorb_norm(*folded[i], norm, where)
    return FoldedSgm(
        sgm.layer, sgm.side, tuple(FoldedConv(*as_float32(where, *conv)) for conv in folded)
    )


def net_fold_error(net: ConvNet, folded: FoldedNet, inputs: Tensor) -> float:
    """Largest |difference| of raw outputs before and after folding; inputs (N, H, W, C)."""
    with torch.no_grad():
        before = copy.deepcopy(net).eval()(as_seen(net.network, inputs))
        after = run_folded(folded, inputs)
    return float((before - after).abs().max())


def sgm_fold_error(sgm: Sgm, folded: FoldedSgm, activation: Tensor, labels: Tensor) -> float:
    """Largest |difference| of gradients before and after folding.

    Args:
        sgm: as trained.
        folded: what :func:`fold_sgm` made of it.
        activation: (N, C, H, W).
        labels: (N, L).
    """
    with torch.no_grad():
        before = copy.deepcopy(sgm).eval()(activation, labels)
        after = run_folded_sgm(folded, activation, labels)
    return float((before - after).abs().max())


def run_folded(folded: FoldedNet, inputs: Tensor) -> Tensor:
    """Raw outputs (N, O, rows, cols) of the folded network on inputs (N, H, W, C)."""
    x = as_seen(folded.network, inputs)
    for number in range(1, folded.network.depth + 1):
        _, x = run_folded_layer(folded, number, x)
    return x


def run_folded_layer(folded: FoldedNet, number: int, x: Tensor) -> tuple[Tensor, Tensor]:
    """Maps (N, Ci, H, W) in front of a layer's pool, and behind it."""
    layer, arrays = folded.network.layer(number), folded.layers[number - 1]
    weight, bias = torch.from_numpy(arrays.weight), torch.from_numpy(arrays.bias)
    convolved = F.conv2d(x, weight, bias, layer.stride, padding=layer.padding)
    convolved = F.relu(convolved) if layer.relu else convolved
    return convolved, F.avg_pool2d(convolved, layer.pool, layer.pool_stride)


def run_folded_sgm(folded: FoldedSgm, activation: Tensor, labels: Tensor) -> Tensor:
    """Activation (N, C, H, W) and labels (N, L) to gradients (N, C, H, W)."""
    filled = labels[:, :, None, None].expand(-1, -1, *activation.shape[2:])
    x = torch.cat([activation, filled], dim=1)
    for conv in folded.convs[:-1]:
        x = F.relu(run_folded_conv(conv, x))
    return run_folded_conv(folded.convs[-1], x)


def run_folded_conv(conv: FoldedConv, x: Tensor) -> Tensor:
    """x (N, I, H, W) to (N, O, H, W)."""
    pad = [side // 2 for side in conv.weight.shape[2:]]
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


def conv_layers(net: ConvNet) -> list[ConvLayer]:
    """A network's layers, in order."""
    return [layer for layer in net.layers if isinstance(layer, ConvLayer)]


def folded_start(net: ConvNet, tuned: int) -> list[tuple[Tensor, Tensor]]:
    """Weight (K, Co), rows ordered (kh, kw, Ci), and bias (Co,) of each of the last layers."""
    start = []
    for layer in _last(net, tuned):
        gain, shift = _affine(layer)
        weight = layer.conv.weight.detach() * gain[:, None, None, None]
        flat = weight.permute(2, 3, 1, 0).reshape(-1, weight.shape[0])
        start.append((flat.contiguous(), _bias(layer) * gain + shift))
    return start


@torch.no_grad()
def write_back(net: ConvNet, start: Sequence[tuple[Tensor, Tensor]]) -> None:
    """Give the last layers convolutions that fold to `start`; the inverse of `folded_start`."""
    for layer, (weight, bias) in zip(_last(net, len(start)), start, strict=True):
        gain, shift = _affine(layer)
        out, into, height, width = layer.conv.weight.shape
        maps = weight.view(height, width, into, out).permute(3, 2, 0, 1)
        layer.conv.weight.copy_(maps / gain[:, None, None, None])
        _bias(layer).copy_((bias - shift) / gain)


def _last(net: ConvNet, tuned: int) -> list[ConvLayer]:
    return conv_layers(net)[-tuned:]


def _affine(layer: ConvLayer) -> tuple[Tensor, Tensor]:
    """Gain and shift (Co,) of a layer's batchnorm: norm(x) = gain * x + shift."""
    norm = layer.norm
    if norm is None:
        return torch.ones_like(_bias(layer)), torch.zeros_like(_bias(layer))
    assert norm.running_mean is not None
    assert norm.running_var is not None
    gain = norm.weight.detach() / torch.sqrt(norm.running_var + norm.eps)
    return gain, norm.bias.detach() - gain * norm.running_mean


def _bias(layer: ConvLayer) -> Tensor:
    assert layer.conv.bias is not None
    return layer.conv.bias.detach()
