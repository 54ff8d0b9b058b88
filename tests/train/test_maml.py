"""Meta-training: its gradients, its bookkeeping, and the runs it keeps going."""

from dataclasses import replace

import pytest
import torch

from qsgm.grasp.network import GRASPNET
from qsgm.grasp.task import GraspTask
from qsgm.train.model.sgm import Sgm
from qsgm.train.pretraining.maml import MamlConfig, MetaTraining, Run, _Unrolled, apply_sgm
from qsgm.train.pretraining.tasks import TaskSet

CONFIG = MamlConfig(
    outer_steps=8,
    tasks_per_step=2,
    unroll=3,
    runs_per_task_slot=1,
    run_lengths=(100,),
    warm_up=1,
)


def tiny_tasks(seed: int = 0) -> TaskSet:
    """Three tasks of 40 crops whose features are non-negative noise."""
    generator = torch.Generator().manual_seed(seed)
    features = torch.rand(3, 40, 169, 16, generator=generator)
    quality = (torch.rand(3, 40, 1, generator=generator) > 0.5).float()
    angle = torch.randn(3, 40, 2, generator=generator)
    angle = angle / angle.norm(dim=-1, keepdim=True) * quality
    return TaskSet(features, torch.cat([quality, angle], dim=-1), support=32)


def tiny_training(
    config: MamlConfig = CONFIG, seed: int = 0, rates: tuple[float, ...] = (0.05, 0.05, 0.05)
) -> MetaTraining:
    torch.manual_seed(seed)
    start = [
        (torch.randn(400, 16) * 0.05, torch.full((16,), 0.1)),
        (torch.randn(16, 16) * 0.3, torch.full((16,), 0.1)),
        (torch.randn(16, 3) * 0.3, torch.zeros(3)),
    ]
    sgms = {layer: Sgm(GRASPNET, layer, (8,)) for layer in (4, 5)}
    return MetaTraining(config, GraspTask(), tiny_tasks(), start, sgms, rates, seed)


# With SGMs that nobody trained, runs at the usual rates blow up or do not, as the seed has it.
SLOW = (1e-3, 1e-3, 1e-3)


def objective_after_one_step(shift: torch.Tensor | None) -> tuple[float, torch.Tensor]:
    """The outer objective, with the first SGM weight moved by `shift`, and its gradient there."""
    torch.set_default_dtype(torch.float64)
    try:
        # The true gradients that are matched are targets, constant to autograd, not to the slope.
        training = tiny_training(replace(CONFIG, matching_weight=0.0))
        training.tasks = TaskSet(
            training.tasks.features.double(), training.tasks.labels.double(), 32
        )
        weight = training.sgms[4].convs[0].weight
        seen: list[torch.Tensor] = []
        training._learn = seen.append  # type: ignore[method-assign]
        with torch.no_grad():
            weight += 0.0 if shift is None else shift
        training.outer_step()
        return seen[0].item(), torch.autograd.grad(seen[0], weight)[0]
    finally:
        torch.set_default_dtype(torch.float32)


def test_the_meta_gradient_equals_finite_differences_through_the_whole_unrolled_run() -> None:
    _, gradient = objective_after_one_step(None)
    direction = torch.randn(gradient.shape, generator=torch.Generator().manual_seed(1)).double()
    step = 1e-7 * direction
    above, below = (objective_after_one_step(sign * step)[0] for sign in (1, -1))
    slope = (above - below) / 2e-7
    assert slope == pytest.approx(float((gradient * direction).sum()), rel=1e-3)
    assert abs(slope) > 1e-6


def test_an_sgm_gives_every_task_what_it_gives_that_task_alone() -> None:
    torch.manual_seed(0)
    sgm = Sgm(GRASPNET, 4, (8,)).eval()
    activation, labels = torch.rand(3, 5, 1, 16), torch.rand(3, 5, 3)
    together = apply_sgm(sgm, activation, labels)
    for task in range(3):
        alone = sgm(activation[task].transpose(1, 2)[..., None], labels[task])[..., 0]
        torch.testing.assert_close(together[task].transpose(1, 2), alone)


def test_a_map_with_many_positions_keeps_its_order() -> None:
    torch.manual_seed(0)
    sgm = Sgm(GRASPNET, 3, (4,)).eval()
    activation, labels = torch.rand(2, 3, 169, 16), torch.rand(2, 3, 3)
    maps = activation[1, 2].T.reshape(1, 16, 13, 13)
    alone = sgm(maps, labels[1, 2][None])[0]
    together = apply_sgm(sgm, activation, labels)[1, 2]
    torch.testing.assert_close(together, alone.reshape(16, 169).T)


def test_outer_steps_change_sgms_start_and_rates_and_lower_the_query_loss() -> None:
    # Three times as fast, one in sixteen trainings diverged.
    config = replace(CONFIG, outer_steps=90, sgm_rate=3e-3, start_rate=3e-3, run_lengths=(9,))
    training = tiny_training(config, rates=SLOW)
    groups = training.optimizer.param_groups
    before = [p.detach().clone() for group in groups for p in group["params"]]
    losses: list[float] = []
    training.run(lambda _, figures: losses.append(figures.query_loss))
    after = [p for group in groups for p in group["params"]]
    assert all(not torch.equal(a, b) for a, b in zip(before, after, strict=True))
    assert sum(losses[-10:]) < sum(losses[:10])


def test_a_run_that_blew_up_starts_afresh_and_teaches_nothing() -> None:
    training = tiny_training(rates=SLOW)
    training.outer_step()
    for run in training.runs:
        assert run.states is not None
        run.states[0].weight[:] = float("nan")
    kept = [p.detach().clone() for p in training._sgm_parameters()]
    training.outer_step()
    assert all(torch.equal(a, b) for a, b in zip(kept, training._sgm_parameters(), strict=True))
    assert all(run.states is None and run.age == 0 for run in training.runs)


def test_a_run_ends_at_its_length_and_another_takes_its_place() -> None:
    training = tiny_training(replace(CONFIG, run_lengths=(6,)), rates=SLOW)
    training.outer_step()
    assert {run.age for run in training.runs} == {3}
    training.outer_step()
    assert {run.age for run in training.runs} == {0}


def test_rates_decay_over_a_run_of_its_own_length_and_are_nothing_beyond_it() -> None:
    training = tiny_training()
    runs = [Run(0, length=4, age=1), Run(1, length=40, age=20), Run(2, length=3, age=5)]
    assert _Unrolled(training, runs)._rate_factors().tolist() == [0.75, 0.5, 0.0]


def test_the_first_step_of_a_run_is_the_devices_with_the_curvature_it_has_learnt() -> None:
    training = tiny_training()
    with torch.no_grad():
        training.curvatures[6].out.mul_(3.0)
    unrolled = _Unrolled(training, [Run(1, length=10)])
    unrolled.advance(torch.Generator().manual_seed(3))
    plain = _Unrolled(tiny_training(), [Run(1, length=10)])
    plain.advance(torch.Generator().manual_seed(3))
    start = training.start[2][0]
    moved, moved_plainly = (run.states[2].weight - start for run in (unrolled, plain))
    torch.testing.assert_close(moved, 3 * moved_plainly)
    assert (moved != 0).any()


def test_a_resumed_training_goes_on_with_the_same_parameters_and_schedule() -> None:
    training = tiny_training()
    for _ in range(3):
        training.outer_step()
    resumed = tiny_training(seed=7)
    resumed.resume(training.state())
    for mine, other in zip(
        resumed.optimizer.param_groups, training.optimizer.param_groups, strict=True
    ):
        assert mine["lr"] == other["lr"]
        for a, b in zip(mine["params"], other["params"], strict=True):
            assert torch.equal(a, b)
