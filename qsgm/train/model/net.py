"""A sequential network in torch: convolutions, each with batchnorm where a ReLU follows."""

from torch import Tensor, nn
from torch.nn import functional as F

from qsgm.network import ONE, Layer, Network
from qsgm.train.model.arrays import PIXEL_RANGE


class Convolution(nn.Conv2d):
    """A convolution whose windows of a single position are taken out of its input before.

    Left to torch 2.13, whose oneDNN steps through the input itself, the way back writes beyond its
    memory where such windows leave out columns and no rows, channels lie last and numbers are
    float32.
    """

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002 torch's name
        if self.kernel_size != ONE or self.padding != (0, 0):
            return super().forward(input)
        down, right = self.stride
        return F.conv2d(input[:, :, ::down, ::right], self.weight, self.bias)


class ConvLayer(nn.Module):
    """Convolution, then batchnorm and ReLU, then average pool, where the layer has them."""

    def __init__(self, layer: Layer) -> None:
        super().__init__()
        self.conv = Convolution(
            layer.into, layer.out, layer.kernel, layer.stride, padding=layer.padding
        )
        self.norm = nn.BatchNorm2d(layer.out) if layer.relu else None
        self.pool = nn.AvgPool2d(layer.pool, layer.pool_stride) if layer.pool != ONE else None

    def forward(self, x: Tensor) -> Tensor:
        x = self.conv(x)
        if self.norm is not None:
            x = F.relu(self.norm(x))
        return x if self.pool is None else self.pool(x)


class ConvNet(nn.Module):
    """Inputs (N, C, H, W), see :func:`as_seen`, to raw outputs (N, O, rows, cols).

    Raw: before the heads' activations.
    """

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network
        self.layers = nn.ModuleList(ConvLayer(layer) for layer in network.layers)

    def forward(self, x: Tensor) -> Tensor:
        return self.between(x, 1, self.network.depth)

    def between(self, x: Tensor, first: int, last: int) -> Tensor:
        """Run layers `first` to `last`, both included, counted from 1."""
        for layer in self.layers[first - 1 : last]:
            x = layer(x)
        return x


def as_seen(network: Network, inputs: Tensor) -> Tensor:
    """Inputs (N, H, W, C) as layer 1 sees them, (N, C, H, W): pixels in [-1, 1]."""
    x = inputs.permute(0, 3, 1, 2)
    return normalize(x) if network.input_kind == "pixels" else x.float()


def normalize(pixels: Tensor) -> Tensor:
    """Pixel values 0 to 255 to [-1, 1]."""
    return pixels.float() / PIXEL_RANGE - 1.0


def maps_of(x: Tensor, side: tuple[int, int]) -> Tensor:
    """Positions (N, P, C), row by row, as maps (N, C, H, W)."""
    maps: Tensor = x.transpose(1, 2).unflatten(2, side)
    return maps


def positions_of(maps: Tensor) -> Tensor:
    """Maps (N, C, H, W) as positions (N, P, C), row by row."""
    return maps.flatten(2).transpose(1, 2).contiguous()
