"""A network of somebody's own: a trained `torch.nn.Sequential` as a :class:`ConvNet`.

What can be taken: convolutions in one and two dimensions, batchnorm, ReLU, average and global
pooling, dense layers (as convolutions as large as their map), flattening; what does nothing when a
network is used (dropout, identity) is passed over. Anything else is named, all of it at once,
before any work starts.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from qsgm.errors import QsgmError
from qsgm.network import ONE, InputKind, Layer, Network, Pair, area
from qsgm.train.model.net import ConvLayer, ConvNet

_NOTHING = (nn.Dropout, nn.Dropout1d, nn.Dropout2d, nn.Identity)
_NORMS = (nn.BatchNorm1d, nn.BatchNorm2d)
_POOLS = (nn.AvgPool1d, nn.AvgPool2d)
_GLOBAL_POOLS = (nn.AdaptiveAvgPool1d, nn.AdaptiveAvgPool2d)


@dataclass(frozen=True)
class _Part:
    """A layer as it is put together: its geometry, its convolution, its norm."""

    layer: Layer
    weight: Tensor  # (Co, Ci, kh, kw)
    bias: Tensor
    norm: nn.BatchNorm1d | nn.BatchNorm2d | None = None


def from_torch(
    module: nn.Sequential, input_shape: tuple[int, int, int], input_kind: InputKind = "numbers"
) -> ConvNet:
    """Take over a sequential network with its weights, in eval mode.

    Args:
        module: whose outputs are those of the result, before the heads' activations.
        input_shape: height, width, channels; a 1-D network has height 1.
        input_kind: `pixels` if the module takes pixels in [-1, 1], `numbers` as they are.

    Raises:
        QsgmError: names every part that cannot be taken.
    """
    flat = [*_flattened(module, "")]
    wrong = [f"{name}: {why}" for name, part in flat if (why := _refusal(part))]
    if wrong:
        raise QsgmError(f"this network cannot be taken over: {'; '.join(wrong)}")
    parts = _parts(flat, input_shape)
    network = Network(input_shape, tuple(part.layer for part in parts), input_kind)
    net = ConvNet(network)
    for target, part in zip(net.layers, parts, strict=True):
        assert isinstance(target, ConvLayer)
        _fill(target, part)
    return net.eval()


def _flattened(module: nn.Module, prefix: str) -> Iterator[tuple[str, nn.Module]]:
    """Every part that does something by its name, inner sequences unpacked."""
    for name, part in module.named_children():
        if isinstance(part, nn.Sequential):
            yield from _flattened(part, f"{prefix}{name}.")
        elif not isinstance(part, _NOTHING):
            yield f"{prefix}{name}", part


def _refusal(part: nn.Module) -> str | None:
    """Why a part cannot be taken; None if it can."""
    kind = type(part).__name__
    if isinstance(part, nn.Conv1d | nn.Conv2d):
        plain = part.groups == 1 and {*_pair(part.dilation)} == {1}
        if not plain or part.padding_mode != "zeros" or isinstance(part.padding, str):
            return f"{kind} with groups, dilation or padding other than a number of zeros"
        return None
    if isinstance(part, _POOLS):
        if part.ceil_mode or {*_pair(part.padding, height=0)} != {0}:
            return f"{kind} with padding or ceil_mode"
        return None
    if isinstance(part, _GLOBAL_POOLS):
        sides = part.output_size if isinstance(part.output_size, tuple) else (part.output_size,)
        return None if {*sides} == {1} else f"{kind} to more than one position"
    if isinstance(part, nn.Flatten):
        return None if (part.start_dim, part.end_dim) == (1, -1) else f"{kind} of some axes only"
    if isinstance(part, _NORMS):
        return None if part.running_mean is not None else f"{kind} without running statistics"
    if isinstance(part, nn.Linear | nn.ReLU):
        return None
    return (
        f"{kind}, expected convolutions, batchnorm, ReLU, average or global pooling, dense layers"
    )


def _parts(flat: list[tuple[str, nn.Module]], input_shape: tuple[int, int, int]) -> list[_Part]:
    """Layers put together, each from its convolution to its pool, in this order."""
    parts: list[_Part] = []
    side: Pair = (input_shape[0], input_shape[1])  # in front of the layer that comes next
    for name, part in flat:
        if isinstance(part, nn.Flatten):
            continue
        if isinstance(part, nn.Conv1d | nn.Conv2d | nn.Linear):
            if parts:
                side = parts[-1].layer.pooled(parts[-1].layer.convolved(side))
            parts.append(_started(name, part, side))
        elif not parts:
            raise QsgmError(f"{name}: a network starts with a convolution or a dense layer")
        else:
            parts[-1] = _added(name, part, parts[-1], side)
    if not parts:
        raise QsgmError("this network has no layer with weights")
    return parts


def _started(name: str, part: nn.Conv1d | nn.Conv2d | nn.Linear, side: Pair) -> _Part:
    """A layer that so far is its convolution; a dense one is as large as its map."""
    weight = part.weight.detach()
    bias = weight.new_zeros(len(weight)) if part.bias is None else part.bias.detach()
    if isinstance(part, nn.Linear):
        if part.in_features % area(side):
            raise QsgmError(f"{name}: {part.in_features} inputs are no maps of {side}")
        maps = weight.reshape(len(weight), -1, *side)
        return _Part(Layer(maps.shape[1], len(maps), side, relu=False), maps, bias)
    if weight.ndim == 3:
        weight = weight[:, :, None]
    out, into, *kernel = weight.shape
    assert not isinstance(part.padding, str), "refused before"
    padding = _pair(part.padding, height=0)
    layer = Layer(into, out, (kernel[0], kernel[1]), _pair(part.stride), padding, relu=False)
    return _Part(layer, weight, bias)


def _added(name: str, part: nn.Module, so_far: _Part, side: Pair) -> _Part:
    """The layer with what stands behind its convolution: norm, ReLU, pool, in this order."""
    layer = so_far.layer
    if isinstance(part, _NORMS) and so_far.norm is None and not layer.relu and layer.pool == ONE:
        return replace(so_far, norm=part)
    if isinstance(part, nn.ReLU) and not layer.relu and layer.pool == ONE:
        return replace(so_far, layer=replace(layer, relu=True))
    if isinstance(part, _POOLS) and layer.pool == ONE:
        pool, stride = _pair(part.kernel_size), _pair(part.stride)
        return replace(so_far, layer=replace(layer, pool=pool, pool_stride=stride))
    if isinstance(part, _GLOBAL_POOLS) and layer.pool == ONE:
        return replace(so_far, layer=replace(layer, pool=layer.convolved(side)))
    raise QsgmError(
        f"{name}: {type(part).__name__} stands where it cannot be taken; expected a layer's parts "
        "in the order convolution, batchnorm, ReLU, pool"
    )


@torch.no_grad()
def _fill(target: ConvLayer, part: _Part) -> None:
    """Give a layer its weights; batchnorm stays as it is, or becomes the identity, or is folded."""
    weight, bias = part.weight, part.bias
    if part.norm is not None and target.norm is None:  # no ReLU behind it: into the convolution
        weight, bias = _folded(weight, bias, part.norm)
    target.conv.weight.copy_(weight)
    assert target.conv.bias is not None
    target.conv.bias.copy_(bias)
    if target.norm is not None:
        _fill_norm(target.norm, part.norm)


def _fill_norm(target: nn.BatchNorm2d, norm: nn.BatchNorm1d | nn.BatchNorm2d | None) -> None:
    """The same norm; without one the identity."""
    assert target.running_mean is not None
    assert target.running_var is not None
    if norm is None:
        target.running_var.fill_(1 - target.eps)
        return
    assert norm.running_mean is not None
    assert norm.running_var is not None
    target.eps = norm.eps
    target.running_mean.copy_(norm.running_mean)
    target.running_var.copy_(norm.running_var)
    if norm.affine:
        target.weight.copy_(norm.weight)
        target.bias.copy_(norm.bias)


def _folded(
    weight: Tensor, bias: Tensor, norm: nn.BatchNorm1d | nn.BatchNorm2d
) -> tuple[Tensor, Tensor]:
    """A convolution that does its batchnorm's work as well."""
    assert norm.running_mean is not None
    assert norm.running_var is not None
    gain = (norm.running_var + norm.eps).rsqrt()
    shift = -norm.running_mean * gain
    if norm.affine:
        shift = shift * norm.weight + norm.bias
        gain = gain * norm.weight
    return weight * gain[:, None, None, None], bias * gain + shift


def _pair(size: int | tuple[int, ...], height: int = 1) -> Pair:
    """A size for both directions; what has one direction only has this height."""
    if isinstance(size, int):
        return size, size
    return (height, size[0]) if len(size) == 1 else (size[0], size[1])
