"""The job of `qsgm finetune` in torch: the same crops, backpropagation through the same layers.

    python -m qsgm.train.grasp.torch_job frame.png BUNDLE LAYERS EPOCHS SEED THREADS

prints one JSON object: seconds per stage, and the scores, which show that it is the same job. It
runs in a process of its own, since torch beside ONNX Runtime slows down both. Loading torch is not
counted, as loading ONNX Runtime is not.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from qsgm.bundle import Bundle, load_bundle
from qsgm.grasp.lesson import GraspLesson
from qsgm.grasp.shown import shown
from qsgm.grasp.source import Demonstration, crop_source
from qsgm.grasp.task import distractors_of, task_of
from qsgm.images import read_demonstration
from qsgm.network import Network
from qsgm.schedule import batches, rate_factor, steps_per_epoch
from qsgm.task import Heads
from qsgm.train.heads import activate, mean_loss
from qsgm.train.model.net import as_seen

RATE = 1e-3  # Adam's, as the paper has it
SLICE = 50  # crops at once

# Weight and bias of each of some consecutive layers, numbered from the first.
Weights = list[tuple[Tensor, Tensor]]


def run(
    frame_path: Path, bundle: Bundle, layers: int, epochs: int, seed: int, threads: int
) -> dict[str, Any]:
    """Seconds per stage and accuracy of one fine-tuning."""
    torch.set_num_threads(threads)
    torch.manual_seed(seed)
    warm_up()
    began = time.perf_counter()
    lesson = lesson_of(frame_path, bundle, seed)
    network, heads = bundle.network, task_of(bundle).heads
    weights, numbers = weights_of(bundle), network.last(layers)
    features, seconds = see(network, weights[:-layers], lesson)
    tuned = weights[-layers:]
    outputs = activate(heads, answers(network, numbers, tuned, features)).numpy()
    labelled = lesson.labelled(outputs)
    labels = torch.from_numpy(labelled.labels)
    began_tuning = time.perf_counter()
    rng = np.random.default_rng([seed, 1])
    tune(network, numbers, tuned, features, labels, heads, lesson.taught, epochs, rng)
    seconds["tuning"] = time.perf_counter() - began_tuning
    rows = np.arange(lesson.taught, len(lesson))
    raw = answers(network, numbers, tuned, features[rows])
    scores = labelled.scores(activate(heads, raw).numpy(), rows)
    seconds["total"] = time.perf_counter() - began
    return {"seconds": seconds, **scores}


def lesson_of(frame_path: Path, bundle: Bundle, seed: int) -> GraspLesson:
    """The crops that `qsgm finetune` makes of a frame."""
    frame = read_demonstration(frame_path)
    height, width = frame.shape[:2]
    seen = shown([Demonstration(frame, (width / 2, height / 2))])
    crops = crop_source(seen.demonstrations, distractors_of(bundle), np.random.default_rng(seed))
    return GraspLesson(crops, task_of(bundle).encoding, seen.turns_rad)


def warm_up() -> None:
    """Make torch load what its first optimizer step loads: a second that is no step's fault."""
    weight = nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.Adam([weight])
    weight.sum().backward()
    optimizer.step()


def weights_of(bundle: Bundle) -> Weights:
    """All layers' starting weights, batchnorm folded."""
    arrays = bundle.start_weights(bundle.network.last(bundle.network.depth))
    found = {name: nn.Parameter(torch.from_numpy(array)) for name, array in arrays.items()}
    numbers = range(1, bundle.network.depth + 1)
    return [(found[f"weight{k}"], found[f"bias{k}"]) for k in numbers]


@torch.inference_mode()
def see(network: Network, frozen: Weights, lesson: GraspLesson) -> tuple[Tensor, dict[str, float]]:
    """Features (N, C, H, W) of all crops, and the seconds of both stages."""
    features, seconds = [], {"crops": 0.0, "features": 0.0}
    for rows in np.split(np.arange(len(lesson)), range(SLICE, len(lesson), SLICE)):
        start = time.perf_counter()
        crops = lesson.cut(rows)
        cut = time.perf_counter()
        x = as_seen(network, torch.from_numpy(crops))
        features.append(forward(network, range(1, len(frozen) + 1), frozen, x))
        seconds["crops"] += cut - start
        seconds["features"] += time.perf_counter() - cut
    return torch.cat(features), seconds


def forward(network: Network, numbers: range, weights: Weights, x: Tensor) -> Tensor:
    """Run these layers on (N, C, H, W)."""
    for number, (weight, bias) in zip(numbers, weights, strict=True):
        layer = network.layer(number)
        x = F.conv2d(x, weight, bias, layer.stride, padding=layer.padding)
        x = F.relu(x) if layer.relu else x
        x = F.avg_pool2d(x, layer.pool, layer.pool_stride)
    return x


@torch.no_grad()
def answers(network: Network, numbers: range, tuned: Weights, features: Tensor) -> Tensor:
    """Raw outputs (N, O) of the last layers, not to be learnt from."""
    return forward(network, numbers, tuned, features).flatten(1)


def tune(
    network: Network,
    numbers: range,
    tuned: Weights,
    features: Tensor,
    labels: Tensor,
    heads: Heads,
    taught: int,
    epochs: int,
    rng: np.random.Generator,
) -> None:
    """Backpropagation through the last layers with Adam, batch by batch."""
    features = features.clone()  # what inference mode made takes no part in autograd
    optimizer = torch.optim.Adam([p for layer in tuned for p in layer], lr=RATE)
    step, steps = 0, epochs * steps_per_epoch(taught)
    for _ in range(epochs):
        for batch in batches(taught, rng):
            rows = torch.from_numpy(batch)
            optimizer.param_groups[0]["lr"] = RATE * rate_factor(step, steps)
            step += 1
            optimizer.zero_grad()
            raw = forward(network, numbers, tuned, features[rows]).flatten(1)
            mean_loss(heads, raw, labels[rows]).backward()
            optimizer.step()


def main() -> None:
    """Run once and print what came of it."""
    frame, folder, *numbers = sys.argv[1:]
    result = run(Path(frame), load_bundle(Path(folder)), *map(int, numbers))
    sys.stdout.write(json.dumps(result) + "\n")


if __name__ == "__main__":
    main()
