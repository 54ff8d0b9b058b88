"""The job of `qsgm finetune` in torch: the same crops, backpropagation through the same layers.

    python -m qsgm.bench.torchjob frame.png BUNDLE LAYERS EPOCHS SEED THREADS

prints one JSON object: seconds per stage, and the accuracy, which shows that it is the same job.
It runs in a process of its own, since torch beside ONNX Runtime slows down both.
"""

import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from qsgm.angles import angle_error, decode_angle, mean_direction
from qsgm.bundle import LAYERS, NETWORK, Bundle, load_bundle, tuned_layers
from qsgm.crops import TRAIN_CROPS, cut_crops, label_crops, plan_crops
from qsgm.finetune import SLICE
from qsgm.images import read_demonstration
from qsgm.tuning import BATCH, batches, rate_factor

if TYPE_CHECKING:
    import torch

RATE = 1e-3  # Adam's, as the paper has it
STRIDES = (2, 2, 2, 2, 1, 1)
POOL_AFTER_LAYER, POOL = 4, 5


def run(
    frame_path: Path, bundle: Bundle, layers: int, epochs: int, seed: int, threads: int
) -> dict[str, Any]:
    """Seconds per stage and accuracy of one fine-tuning."""
    began = time.perf_counter()
    import torch

    torch.set_num_threads(threads)
    torch.manual_seed(seed)
    warm_up()
    seconds = {"import": time.perf_counter() - began, "crops": 0.0, "features": 0.0}
    frame = read_demonstration(frame_path)
    height, width = frame.shape[:2]
    plan = plan_crops((height, width), (width / 2, height / 2), np.random.default_rng(seed))
    convolutions = load_layers(bundle)
    features = []
    for first in range(0, len(plan), SLICE):
        start = time.perf_counter()
        crops = cut_crops(frame, plan[first : first + SLICE])
        cut = time.perf_counter()
        with torch.inference_mode():
            x = torch.from_numpy(crops).permute(0, 3, 1, 2).float()
            features.append(forward(convolutions, x, range(1, LAYERS + 1 - layers)))
        seconds["crops"] += cut - start
        seconds["features"] += time.perf_counter() - cut
    seen = torch.cat(features).clone()
    with torch.no_grad():
        turned = angles(forward(convolutions, seen, tuned_layers(layers)), bundle)
    positive = np.flatnonzero(plan.quality[:TRAIN_CROPS] > 0)
    offset, _ = mean_direction(turned[positive] - plan.turn_rad[positive])
    labels = torch.from_numpy(label_crops(plan, offset, bundle.encoding))
    began_tuning = time.perf_counter()
    tune(convolutions, seen, labels, layers, epochs, bundle, np.random.default_rng([seed, 1]))
    seconds["tuning"] = time.perf_counter() - began_tuning
    with torch.no_grad():
        raw = forward(convolutions, seen[TRAIN_CROPS:], tuned_layers(layers))
    seconds["total"] = time.perf_counter() - began
    yes = plan.quality[TRAIN_CROPS:] > 0
    error = angle_error(angles(raw, bundle)[yes], plan.turn_rad[TRAIN_CROPS:][yes] + offset)
    return {
        "seconds": seconds,
        "detection_accuracy": float(np.mean((raw[:, 0].numpy() > 0) == yes)),
        "angle_mae_deg": float(np.degrees(error.mean())),
    }


def warm_up() -> None:
    """Make torch load what its first optimizer step loads: a second that is no step's fault."""
    import torch

    weight = torch.nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.Adam([weight])
    weight.sum().backward()
    optimizer.step()


def load_layers(bundle: Bundle) -> "list[torch.nn.Conv2d]":
    """All layers with the bundle's starting weights, batchnorm folded."""
    import onnx
    import torch
    from onnx import numpy_helper

    network, convolutions = onnx.load(bundle.folder / NETWORK), []
    weights = {
        tensor.name: torch.tensor(numpy_helper.to_array(tensor))
        for tensor in network.graph.initializer
    }
    for number, stride in enumerate(STRIDES, start=1):
        weight, bias = weights[f"weight{number}"], weights[f"bias{number}"]
        conv = torch.nn.Conv2d(weight.shape[1], weight.shape[0], weight.shape[2], stride)
        conv.load_state_dict({"weight": weight, "bias": bias})
        convolutions.append(conv)
    return convolutions


def forward(
    convolutions: "list[torch.nn.Conv2d]", x: "torch.Tensor", layers: range
) -> "torch.Tensor":
    """Run these layers on (N, C, H, W); after the last one (N, 3)."""
    import torch.nn.functional as F

    for number in layers:
        x = convolutions[number - 1](x)
        x = F.relu(x) if number < LAYERS else x
        x = F.avg_pool2d(x, POOL, stride=1) if number == POOL_AFTER_LAYER else x
    return x.flatten(1) if layers.stop > LAYERS else x


def tune(
    convolutions: "list[torch.nn.Conv2d]",
    features: "torch.Tensor",
    labels: "torch.Tensor",
    layers: int,
    epochs: int,
    bundle: Bundle,
    rng: np.random.Generator,
) -> None:
    """Backpropagation through the last layers with Adam, batch by batch."""
    import torch

    parameters = [p for k in tuned_layers(layers) for p in convolutions[k - 1].parameters()]
    optimizer = torch.optim.Adam(parameters, lr=RATE)
    step, steps = 0, epochs * -(-TRAIN_CROPS // BATCH)
    for _ in range(epochs):
        for batch in batches(TRAIN_CROPS, rng):
            rows = torch.from_numpy(batch)
            optimizer.param_groups[0]["lr"] = RATE * rate_factor(step, steps)
            step += 1
            optimizer.zero_grad()
            raw = forward(convolutions, features[rows], tuned_layers(layers))
            loss(raw, labels[rows], bundle).backward()  # type: ignore[no-untyped-call,unused-ignore]
            optimizer.step()


def loss(raw: "torch.Tensor", labels: "torch.Tensor", bundle: Bundle) -> "torch.Tensor":
    """Log loss on quality plus l2 on the angle channels of the positives."""
    import torch.nn.functional as F

    smoothing = bundle.label_smoothing
    target = labels[:, 0] * (1 - smoothing) + smoothing / 2
    quality = F.binary_cross_entropy_with_logits(raw[:, 0], target)
    angle = (activated(raw, bundle) - labels[:, 1:]).square().sum(dim=1)
    return quality + (labels[:, 0] * angle).mean()


def activated(raw: "torch.Tensor", bundle: Bundle) -> "torch.Tensor":
    """Sine and cosine (N, 2) of raw outputs (N, 3)."""
    import torch

    cosine = torch.tanh if bundle.encoding == "double" else torch.sigmoid
    return torch.stack([torch.tanh(raw[:, 1]), cosine(raw[:, 2])], dim=1)


def angles(raw: "torch.Tensor", bundle: Bundle) -> "np.ndarray[Any, np.dtype[np.float64]]":
    """Angles [rad] (N,) of raw outputs (N, 3)."""
    channels = activated(raw, bundle).numpy()
    return decode_angle(channels[:, 0], channels[:, 1], bundle.encoding)


def main() -> None:
    """Run once and print what came of it."""
    frame, folder, *numbers = sys.argv[1:]
    result = run(Path(frame), load_bundle(Path(folder)), *map(int, numbers))
    sys.stdout.write(json.dumps(result) + "\n")


if __name__ == "__main__":
    main()
