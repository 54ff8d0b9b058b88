"""The tuned layers' start: out of the network into weights without batchnorm, and back.

The device trains folded weights, so meta-training has to as well. What it learns is written back
in front of the batchnorm it was folded with, which is what `sgm.pt` keeps.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from qsgm.train.model.graspnet import LAYERS, GraspNet, Layer


def folded_start(net: GraspNet, tuned: int) -> list[tuple[Tensor, Tensor]]:
    """Weight (K, Co), rows ordered (kh, kw, Ci), and bias (Co,) of each of the last layers."""
    start = []
    for layer in _last(net, tuned):
        gain, shift = _affine(layer)
        weight = layer.conv.weight.detach() * gain[:, None, None, None]
        flat = weight.permute(2, 3, 1, 0).reshape(-1, weight.shape[0])
        start.append((flat.contiguous(), _bias(layer) * gain + shift))
    return start


@torch.no_grad()
def write_back(net: GraspNet, start: Sequence[tuple[Tensor, Tensor]]) -> None:
    """Give the last layers convolutions that fold to `start`; the inverse of `folded_start`."""
    for layer, (weight, bias) in zip(_last(net, len(start)), start, strict=True):
        gain, shift = _affine(layer)
        out, into, height, width = layer.conv.weight.shape
        maps = weight.view(height, width, into, out).permute(3, 2, 0, 1)
        layer.conv.weight.copy_(maps / gain[:, None, None, None])
        _bias(layer).copy_((bias - shift) / gain)


def _last(net: GraspNet, tuned: int) -> list[Layer]:
    return [layer for layer in net.layers[LAYERS - tuned :] if isinstance(layer, Layer)]


def _affine(layer: Layer) -> tuple[Tensor, Tensor]:
    """Gain and shift (Co,) of a layer's batchnorm: norm(x) = gain * x + shift."""
    norm = layer.norm
    if norm is None:
        return torch.ones_like(_bias(layer)), torch.zeros_like(_bias(layer))
    assert norm.running_mean is not None
    assert norm.running_var is not None
    gain = norm.weight.detach() / torch.sqrt(norm.running_var + norm.eps)
    return gain, norm.bias.detach() - gain * norm.running_mean


def _bias(layer: Layer) -> Tensor:
    assert layer.conv.bias is not None
    return layer.conv.bias.detach()
