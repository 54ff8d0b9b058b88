"""The job of `qsgm finetune` in torch: the same crops, backpropagation through the same layers.

    python -m qsgm.train.torchjob frame.png BUNDLE LAYERS EPOCHS SEED THREADS

prints one JSON object: seconds per stage, and the accuracy, which shows that it is the same job.
It runs in a process of its own, since torch beside ONNX Runtime slows down both. Loading torch is
not counted, as loading ONNX Runtime is not.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import numpy_helper
from torch import Tensor, nn
from torch.nn import functional as F

from qsgm.bundle import NETWORK, Bundle, load_bundle
from qsgm.grasp.angles import angle_error, decode_angle, mean_direction
from qsgm.grasp.crops import TRAIN_CROPS, CropPlan, label_crops
from qsgm.grasp.shown import shown
from qsgm.grasp.source import CropSource, Demonstration, crop_source
from qsgm.images import read_demonstration
from qsgm.train.model.graspnet import LAYERS, POOL, POOL_AFTER_LAYER, STRIDES, Loss, normalize
from qsgm.tune.loop import BATCH, batches, rate_factor

RATE = 1e-3  # Adam's, as the paper has it
SLICE = 50  # crops at once


def run(
    frame_path: Path, bundle: Bundle, layers: int, epochs: int, seed: int, threads: int
) -> dict[str, Any]:
    """Seconds per stage and accuracy of one fine-tuning."""
    torch.set_num_threads(threads)
    torch.manual_seed(seed)
    warm_up()
    began = time.perf_counter()
    seconds = {"crops": 0.0, "features": 0.0}
    frame = read_demonstration(frame_path)
    height, width = frame.shape[:2]
    seen = shown([Demonstration(frame, (width / 2, height / 2))])
    rng = np.random.default_rng(seed)
    crops = crop_source(seen.demonstrations, bundle.distractors(), rng)
    plan = crops.plan
    convolutions = load_layers(bundle)
    features = see(convolutions[:-layers], crops, seconds)
    tuned, loss = convolutions[-layers:], Loss(bundle.encoding, bundle.label_smoothing)
    turned = angles(answers(tuned, features), loss)
    positive = np.flatnonzero(plan.quality[:TRAIN_CROPS] > 0)
    offset, _ = mean_direction(turned[positive] - plan.turn_rad[positive])
    labels = torch.from_numpy(label_crops(plan, offset, bundle.encoding))
    began_tuning = time.perf_counter()
    tune(tuned, features, labels, loss, epochs, np.random.default_rng([seed, 1]))
    seconds["tuning"] = time.perf_counter() - began_tuning
    raw = answers(tuned, features[TRAIN_CROPS:])
    seconds["total"] = time.perf_counter() - began
    return {"seconds": seconds, **accuracy(raw, plan[TRAIN_CROPS:], offset, loss)}


def warm_up() -> None:
    """Make torch load what its first optimizer step loads: a second that is no step's fault."""
    weight = nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.Adam([weight])
    weight.sum().backward()
    optimizer.step()


def load_layers(bundle: Bundle) -> list[nn.Conv2d]:
    """All layers with the bundle's starting weights, batchnorm folded."""
    network, convolutions = onnx.load(bundle.folder / NETWORK), []
    weights = {
        tensor.name: torch.tensor(numpy_helper.to_array(tensor))
        for tensor in network.graph.initializer
    }
    for number, stride in enumerate(STRIDES, start=1):
        weight, bias = weights[f"weight{number}"], weights[f"bias{number}"]
        conv = nn.Conv2d(weight.shape[1], weight.shape[0], weight.shape[2], stride)
        conv.load_state_dict({"weight": weight, "bias": bias})
        convolutions.append(conv)
    return convolutions


@torch.inference_mode()
def see(frozen: list[nn.Conv2d], source: CropSource, seconds: dict[str, float]) -> Tensor:
    """Features (N, C, H, W) of the planned crops; adds to the seconds of both stages."""
    features = []
    for rows in np.split(np.arange(len(source)), range(SLICE, len(source), SLICE)):
        start = time.perf_counter()
        crops = source.cut(rows)
        cut = time.perf_counter()
        x = normalize(torch.from_numpy(crops))
        features.append(forward(frozen, 1, x))
        seconds["crops"] += cut - start
        seconds["features"] += time.perf_counter() - cut
    return torch.cat(features)


def forward(convolutions: list[nn.Conv2d], first: int, x: Tensor) -> Tensor:
    """Run consecutive layers, the first of them numbered `first`, on (N, C, H, W)."""
    for number, conv in enumerate(convolutions, start=first):
        x = conv(x)
        x = F.relu(x) if number < LAYERS else x
        x = F.avg_pool2d(x, POOL, stride=1) if number == POOL_AFTER_LAYER else x
    return x


def outputs(tuned: list[nn.Conv2d], features: Tensor) -> Tensor:
    """Raw outputs (N, 3) of the last layers."""
    return forward(tuned, LAYERS + 1 - len(tuned), features).flatten(1)


@torch.no_grad()
def answers(tuned: list[nn.Conv2d], features: Tensor) -> Tensor:
    """As :func:`outputs`, not to be learnt from."""
    return outputs(tuned, features)


def tune(
    tuned: list[nn.Conv2d],
    features: Tensor,
    labels: Tensor,
    loss: Loss,
    epochs: int,
    rng: np.random.Generator,
) -> None:
    """Backpropagation through the last layers with Adam, batch by batch."""
    features = features.clone()  # what inference mode made takes no part in autograd
    optimizer = torch.optim.Adam([p for conv in tuned for p in conv.parameters()], lr=RATE)
    step, steps = 0, epochs * -(-TRAIN_CROPS // BATCH)
    for _ in range(epochs):
        for batch in batches(TRAIN_CROPS, rng):
            rows = torch.from_numpy(batch)
            optimizer.param_groups[0]["lr"] = RATE * rate_factor(step, steps)
            step += 1
            optimizer.zero_grad()
            loss(outputs(tuned, features[rows]), labels[rows]).backward()
            optimizer.step()


def angles(raw: Tensor, loss: Loss) -> NDArray[np.float64]:
    """Angles [rad] (N,) of raw outputs (N, 3)."""
    activated = loss.activate(raw).numpy()
    return decode_angle(activated[:, 1], activated[:, 2], loss.encoding)


def accuracy(raw: Tensor, plan: CropPlan, offset_rad: float, loss: Loss) -> dict[str, float]:
    """Of raw outputs (N, 3) on as many planned crops."""
    yes = plan.quality > 0
    error = angle_error(angles(raw, loss)[yes], plan.turn_rad[yes] + offset_rad)
    return {
        "detection_accuracy": float(np.mean((raw[:, 0].numpy() > 0) == yes)),
        "angle_mae_deg": float(np.degrees(error.mean())),
    }


def main() -> None:
    """Run once and print what came of it."""
    frame, folder, *numbers = sys.argv[1:]
    result = run(Path(frame), load_bundle(Path(folder)), *map(int, numbers))
    sys.stdout.write(json.dumps(result) + "\n")


if __name__ == "__main__":
    main()
