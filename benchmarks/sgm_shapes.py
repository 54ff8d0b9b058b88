"""How well SGMs of several shapes can match true gradients, and what makes it hard.

    python benchmarks/sgm_shapes.py sgm.pt

Every shape regresses true gradients along backpropagation runs on drawn objects and is then
compared with them, batch by batch, along runs on objects of its own: once with the layers behind
layer 4 held still, once with all three layers learning at the same rate.
"""

import sys
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table
from torch.nn.functional import cosine_similarity

from qsgm.schedule import BATCH
from qsgm.train.checkpoint import load_checkpoint
from qsgm.train.grasp.task import DrawnGrasping
from qsgm.train.model.fold import folded_start
from qsgm.train.model.net import maps_of, positions_of
from qsgm.train.model.sgm import Sgm
from qsgm.train.pretraining.matching import Examples, MatchingConfig, fit_sgm, record_examples
from qsgm.train.pretraining.tasks import draw_tasks

SHAPES = ((16,), (32,), (128,), (32, 32), (64, 64), (128, 128))
MOVING = {"layers 5, 6 held still": (0.01, 0.0, 0.0), "all at one rate": (0.01, 0.01, 0.01)}
TASKS, TEST_TASKS, CROPS, SEED = 100, 16, 400, 11


def mean_cosine(sgm: Sgm, examples: Examples) -> float:
    """Mean over batches of the cosine to the true gradient."""
    with torch.no_grad():
        given = positions_of(sgm(maps_of(examples.activations, sgm.side), examples.labels))
    batches = given.unflatten(0, (-1, BATCH)), examples.gradients.unflatten(0, (-1, BATCH))
    return float(cosine_similarity(*(batch.flatten(1) for batch in batches)).mean())


def main(path: Path) -> None:
    """Print the table."""
    torch.set_num_threads(1)
    net, task = load_checkpoint(path).net, DrawnGrasping()
    tuned = task.network.last(3)
    config = MatchingConfig(fit_steps=1500)
    sets = [
        draw_tasks(net, task, count, CROPS, SEED + i, lambda: None, tuned[0] - 1)
        for i, count in enumerate((TASKS, TEST_TASKS))
    ]
    table = Table("hidden", "layer", *MOVING)
    for hidden in SHAPES:
        rows: dict[int, list[str]] = {}
        for rates in MOVING.values():
            start = folded_start(net, len(tuned))
            train, test = (record_examples(s, start, rates, task, config, SEED) for s in sets)
            for layer in tuned[:-1]:
                torch.manual_seed(SEED)
                sgm = fit_sgm(
                    Sgm(task.network, layer, hidden), train[layer], config, SEED, lambda: None
                )
                rows.setdefault(layer, []).append(f"{mean_cosine(sgm, test[layer]):.3f}")
        for layer, cells in rows.items():
            table.add_row(" x ".join(map(str, hidden)), str(layer), *cells)
    Console().print(table)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
