"""What each part of the meta-training is worth: variants of it, from the same regressed SGMs.

    python benchmarks/meta_variants.py sgm.pt [--steps 600] [--only NAME ...]

Takes the checkpoint's network, regresses SGMs on drawn objects, meta-trains them in the way of each
variant, and fine-tunes three layers for elongated drawn objects of another seed, for 1, 3 and 20
epochs. Prints the angle error [deg] of each, and every SGM's cosine to the true gradient, the mean
along the longest run. Backpropagation: the best of a few rates for every run length.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor
from torch.nn import functional as F

from qsgm.task import Head
from qsgm.train.checkpoint import load_checkpoint
from qsgm.train.grasp.objects import draw_frame
from qsgm.train.grasp.task import DrawnGrasping
from qsgm.train.heads import meta_objective, per_sample
from qsgm.train.model.fold import folded_start
from qsgm.train.model.local import LayerState, columns, layer_forward, true_gradients
from qsgm.train.model.net import ConvNet
from qsgm.train.model.sgm import Sgm
from qsgm.train.paper.baselines.backpropagation import Backpropagation
from qsgm.train.paper.baselines.tuning import Recipe, adam, run_baseline, sgd
from qsgm.train.pretraining import maml
from qsgm.train.pretraining.evaluate import UpdateRule, fine_tune, mean_score, score
from qsgm.train.pretraining.maml import MamlConfig, MetaTraining
from qsgm.train.pretraining.matching import MatchingConfig, fit_sgm, record_examples
from qsgm.train.pretraining.pretrain import PretrainConfig
from qsgm.train.pretraining.tasks import TaskSet, draw_tasks

EPOCHS, ANGLE = (1, 3, 20), "angle_mae_deg"
TASKS, CROPS, SEED = 240, 400, 21
TEST_TASKS, TEST_CROPS, LEAST_ELONGATION = 32, 1000, 1.6
GRID = {sgd: (0.003, 0.01, 0.02, 0.03), adam: (0.001, 0.002, 0.003)}


Objective = Callable[[Sequence[Head], Tensor, Tensor], Tensor]
TASK = DrawnGrasping()
FIRST_RATES = PretrainConfig().first_rates
TUNED = TASK.network.last(len(FIRST_RATES))


def plain_loss(heads: Sequence[Head], raw: Tensor, labels: Tensor) -> Tensor:
    """The mean loss of every task."""
    return per_sample(heads, raw, labels).mean(dim=1)


def variants(steps: int) -> dict[str, tuple[MamlConfig, Objective]]:
    """By name, the first one as shipped but for the number of steps."""
    usual = MamlConfig(outer_steps=steps)
    return {
        "as shipped": (usual, meta_objective),
        "plain loss": (usual, plain_loss),
        "no curvature": (replace(usual, curvature_rate=0.0), meta_objective),
        "matching weight 1": (replace(usual, matching_weight=1.0), meta_objective),
        "matching weight 0": (replace(usual, matching_weight=0.0), meta_objective),
        "long runs only": (replace(usual, run_lengths=(500,)), meta_objective),
    }


def drawn(net: ConvNet, count: int, crops: int, seed: int) -> TaskSet:
    """Tasks as the meta-training has them."""
    return draw_tasks(net, TASK, count, crops, seed, lambda: None, TUNED[0] - 1)


def regressed(net: ConvNet, tasks: TaskSet) -> dict[int, Sgm]:
    """SGMs behind layers 4 and 5 after the second stage."""
    config, start = MatchingConfig(), folded_start(net, len(TUNED))
    examples = record_examples(tasks, start, (FIRST_RATES[0], 0, 0), TASK, config, SEED)
    torch.manual_seed(SEED)
    sgms = {layer: Sgm(TASK.network, layer, (64, 64)) for layer in TUNED[:-1]}
    return {k: fit_sgm(sgm, examples[k], config, SEED, lambda: None) for k, sgm in sgms.items()}


def elongated(tasks: TaskSet, seed: int) -> TaskSet:
    """Those of the drawn tasks whose object has an axis."""
    frames = [draw_frame(np.random.default_rng((seed, i))) for i in range(len(tasks))]
    rows = [i for i, frame in enumerate(frames) if frame.elongation > LEAST_ELONGATION]
    return TaskSet(tasks.features[rows], tasks.labels[rows], tasks.support)


@torch.no_grad()
def measure(rule: UpdateRule, start: list[tuple[Tensor, Tensor]], tasks: TaskSet) -> list[str]:
    """Angle errors after each run length, then the mean cosines of the longest."""
    cells, cosines = [], []
    for epochs in EPOCHS:
        scores = []
        for some in tasks.chunks(8):
            for states in fine_tune(rule, start, some, epochs):
                if epochs == EPOCHS[-1]:
                    cosines.append(cosine_to_truth(rule, states, some))
            scores += score(states, some, TASK)
        cells.append(f"{mean_score(scores).scores[ANGLE]:.2f}")
    return cells + [f"{value:.2f}" for value in torch.stack(cosines).mean(dim=0).tolist()]


def cosine_to_truth(rule: UpdateRule, states: list[LayerState], tasks: TaskSet) -> Tensor:
    """Of the SGMs behind layers 4 and 5 on one batch: (2,)."""
    x, labels = tasks.features[:, :32].float(), tasks.labels[:, :32]
    true = true_gradients(TASK.network, states, x, labels, TASK.heads)
    found = []
    for layer, state in zip(TUNED[:-1], states, strict=False):
        _, x = layer_forward(TASK.network, layer, state, columns(TASK.network, layer, x))
        given = rule.gradient_of(layer, x, labels)
        found.append(F.cosine_similarity(given.flatten(1), true[layer].flatten(1)).mean())
    return torch.stack(found)


def best_backpropagation(start: list[tuple[Tensor, Tensor]], tasks: TaskSet) -> list[str]:
    """The lowest angle error of the grid for each run length."""
    cells = []
    for epochs in EPOCHS:
        recipes = [Recipe(o, (r,) * len(TUNED), epochs) for o, rates in GRID.items() for r in rates]
        scores = [run_baseline(tasks, start, Backpropagation(), r, TASK, 0) for r in recipes]
        cells.append(f"{min(mean_score(some).scores[ANGLE] for some in scores):.2f}")
    return [*cells, "1", "1"]


def main(path: Path, steps: int, only: list[str], show: Callable[[object], None]) -> None:
    """Print a row per variant."""
    torch.set_num_threads(1)
    net = load_checkpoint(path).net
    tasks = drawn(net, TASKS, CROPS, SEED)
    test = elongated(drawn(net, TEST_TASKS, TEST_CROPS, SEED + 1), SEED + 1)
    sgms = regressed(net, tasks)
    table = Table("variant", *(f"{epochs} ep." for epochs in EPOCHS), "cos 4", "cos 5")
    table.add_row("backpropagation", *best_backpropagation(folded_start(net, len(TUNED)), test))
    for name, (config, objective) in variants(steps).items():
        if only and name not in only:
            continue
        fresh = {layer: Sgm(TASK.network, layer, sgm.hidden) for layer, sgm in sgms.items()}
        for layer, sgm in fresh.items():
            sgm.load_state_dict(sgms[layer].state_dict())
        training = MetaTraining(
            config, TASK, tasks, folded_start(net, len(TUNED)), fresh, FIRST_RATES, SEED
        )
        with patch.object(maml, "meta_objective", objective):
            training.run(lambda *_: None)
        rates = tuple(training.log_rates.detach().exp().tolist())
        rule = UpdateRule(fresh, training.learnt_curvatures(), rates, TASK)
        start = [(weight.detach(), bias.detach()) for weight, bias in training.start]
        table.add_row(name, *measure(rule, start, test))
        show(table)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--only", nargs="*", default=[])
    given = parser.parse_args()
    main(given.checkpoint, given.steps, given.only, Console().print)
