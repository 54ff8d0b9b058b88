"""A training step in torch: eager, compiled, or by executorch's training extension.

    python torch_steps.py eager|compile|executorch data.npz THREADS SECONDS

prints one JSON object. The data are those of step_data.py. Nothing of qsgm is imported.
"""

import importlib
import sys
import time
from collections.abc import Callable, Mapping
from importlib import metadata
from typing import Any

import numpy as np
import torch
from steps import Step, tell, timed_steps
from torch import Tensor, nn
from torch.nn import functional as F

KINDS = ("weight", "bias")
EXECUTORCH = ("executorch.exir", "executorch.extension.training")


class Net(nn.Module):
    """The tuned layers and their loss: features (B, C, H, W) and labels (B, 3) to a scalar."""

    def __init__(self, data: Mapping[str, Any]) -> None:
        super().__init__()
        self.convolutions = nn.ModuleList()
        for number, stride in zip(data["layers"], data["strides"].tolist(), strict=True):
            weight, bias = (torch.from_numpy(data[f"{kind}{number}"]) for kind in KINDS)
            conv = nn.Conv2d(weight.shape[1], weight.shape[0], weight.shape[2], stride)
            conv.load_state_dict({"weight": weight, "bias": bias})
            self.convolutions.append(conv)
        self.pools: list[int] = data["pools"].tolist()
        self.encoding = str(data["encoding"])
        self.smoothing = float(data["smoothing"])
        self.angle_weight = float(data["angle_weight"])

    def forward(self, x: Tensor, labels: Tensor) -> Tensor:
        last = len(self.pools) - 1
        for number, (conv, side) in enumerate(zip(self.convolutions, self.pools, strict=True)):
            x = conv(x)
            x = F.relu(x) if number < last else x
            x = self.pool(x, side) if side > 1 else x
        return self.loss(x.flatten(1), labels)

    def pool(self, x: Tensor, side: int) -> Tensor:
        return F.avg_pool2d(x, side, stride=1)

    def loss(self, raw: Tensor, labels: Tensor) -> Tensor:
        """Mean over a batch of raw outputs (B, 3): log loss, and l2 on the positives' angles."""
        target = labels[:, 0] * (1 - self.smoothing) + self.smoothing / 2
        quality = F.binary_cross_entropy_with_logits(raw[:, 0], target)
        cosine = torch.tanh(raw[:, 2]) if self.encoding == "double" else torch.sigmoid(raw[:, 2])
        miss = torch.stack([torch.tanh(raw[:, 1]), cosine], dim=1) - labels[:, 1:]
        angle = labels[:, 0] * (miss * miss).sum(dim=1)
        return quality + self.angle_weight * angle.mean()


class ExportedNet(Net):
    """The same without a pool's gradient, which executorch lacks: a crop's pool is a mean."""

    def pool(self, x: Tensor, side: int) -> Tensor:  # noqa: ARG002
        return x.mean((2, 3), keepdim=True)


def eager_step(data: Mapping[str, Any], threads: int) -> Step:
    """As it is usually written."""
    torch.set_num_threads(threads)
    net = Net(data)
    return torch_step(net, net, data)


def compiled_step(data: Mapping[str, Any], threads: int) -> Step:
    """The same, forward and backward pass compiled for this batch's shape."""
    torch.set_num_threads(threads)
    net = Net(data)
    return torch_step(net, torch.compile(net, dynamic=False), data)


def torch_step(net: Net, loss_of: Callable[..., Tensor], data: Mapping[str, Any]) -> Step:
    """SGD with momentum, in the quickest of its forms on a CPU."""
    rate, momentum = float(data["rate"]), float(data["momentum"])
    optimizer = torch.optim.SGD(net.parameters(), lr=rate, momentum=momentum, fused=True)

    def step(x: Tensor, labels: Tensor) -> float:
        optimizer.zero_grad()
        loss = loss_of(x, labels)
        loss.backward()
        optimizer.step()
        return loss.item()

    return step


def executorch_step(data: Mapping[str, Any], threads: int) -> Step:
    """Exported together with its backward pass, run and updated by executorch."""
    from executorch.exir import to_edge
    from executorch.extension.pybindings import portable_lib
    from executorch.extension.training import (
        _load_for_executorch_for_training_from_buffer,
        get_sgd_optimizer,
    )
    from torch.export.experimental import _export_forward_backward

    portable_lib._unsafe_reset_threadpool(threads)
    batch = data["rows"][0]
    example = tuple(torch.from_numpy(data[name][batch]) for name in ("features", "labels"))
    exported = torch.export.export(ExportedNet(data), example, strict=True)
    program = to_edge(_export_forward_backward(exported)).to_executorch()
    buffer = program.buffer
    module = _load_for_executorch_for_training_from_buffer(buffer)
    # It knows its parameters only after a pass.
    module.forward_backward("forward", example)
    rate, momentum = float(data["rate"]), float(data["momentum"])
    optimizer = get_sgd_optimizer(module.named_parameters(), rate, momentum, 0, 0, False)

    def step(x: Tensor, labels: Tensor, _: bytes = buffer) -> float:  # which the module reads
        (loss,) = module.forward_backward("forward", (x, labels))
        optimizer.step(module.named_gradients())
        return float(loss)

    return step


STEPS = {"eager": eager_step, "compile": compiled_step, "executorch": executorch_step}


def main() -> None:
    """Run once and print what came of it."""
    name, path, threads, seconds = sys.argv[1:]
    for module in EXECUTORCH if name == "executorch" else ():
        importlib.import_module(module)
    imported_at, began = time.time(), time.perf_counter()
    data = dict(np.load(path))
    step = STEPS[name](data, int(threads))
    built = time.perf_counter() - began
    arrays = (torch.from_numpy(data[name]) for name in ("features", "labels", "rows"))
    version = metadata.version("executorch" if name == "executorch" else "torch")
    tell(version, imported_at, built, *timed_steps(step, *arrays, float(seconds)))


if __name__ == "__main__":
    main()
