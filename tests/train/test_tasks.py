"""Drawn training data, alignment, scores and recorded gradients."""

import numpy as np
import pytest
import torch
from losses import GraspLoss

from qsgm.errors import QsgmError
from qsgm.grasp.angles import AngleEncoding, angle_error, decode_angle, encode_angle
from qsgm.grasp.crops import label_crops, plan_crops
from qsgm.grasp.network import GRASPNET
from qsgm.grasp.task import GraspTask
from qsgm.train.grasp.task import DrawnGrasping, frame_lesson
from qsgm.train.heads import activate
from qsgm.train.model.fold import folded_start
from qsgm.train.model.local import true_gradients
from qsgm.train.model.net import ConvNet
from qsgm.train.model.sgm import Sgm
from qsgm.train.pretraining.backbone import BackboneConfig, BackboneTraining
from qsgm.train.pretraining.evaluate import Score, best_rates, score
from qsgm.train.pretraining.matching import MatchingConfig, fit_sgm, record_examples
from qsgm.train.pretraining.tasks import (
    ExampleStream,
    TaskSet,
    draw_tasks,
    start_states,
)


def raw_for(angle_rad: np.ndarray, quality: np.ndarray) -> torch.Tensor:
    """Raw outputs of a network that sees these angles and qualities."""
    channels = np.arctanh(0.99 * encode_angle(angle_rad))
    return torch.tensor(np.concatenate([8 * (quality[:, None] - 0.5), channels], axis=1))


@pytest.mark.parametrize("offset", [-1.2, 0.0, 0.7, 1.5])
def test_the_offset_is_how_the_network_sees_the_demonstration_turned(offset: float) -> None:
    task, frame = GraspTask(), np.zeros((480, 640, 3), np.uint8)
    lesson = frame_lesson(frame, np.random.default_rng(0), 200, task)
    plan = lesson.crops.plan
    seen = activate(task.heads, raw_for(plan.turn_rad + offset, plan.quality)).numpy()
    found = lesson.orientation(seen).offset_rad
    assert angle_error(np.array(found), np.array(offset)) < 1e-3
    labelled = lesson.labelled(seen)
    assert angle_error(labelled.angle_rad, plan.turn_rad + offset).max() < 1e-3
    np.testing.assert_allclose(labelled.labels, label_crops(plan, found), atol=1e-6)


def test_a_drawn_batch_depends_on_its_number_and_seed_only() -> None:
    crops, labels = ExampleStream(DrawnGrasping("double"), 5, 10, 6)[3]
    again, labels_again = ExampleStream(DrawnGrasping("double"), 5, 10, 6)[3]
    other, _ = ExampleStream(DrawnGrasping("double"), 6, 10, 6)[3]
    assert torch.equal(crops, again)
    assert torch.equal(labels, labels_again)
    assert not torch.equal(crops, other)
    assert crops.shape == (6, 128, 128, 3)


@pytest.mark.parametrize("encoding", ["double", "paper"])
def test_the_backbone_is_taught_angles_as_its_loss_encodes_them(encoding: AngleEncoding) -> None:
    config = BackboneConfig(steps=3, frames_per_batch=4, crops_per_frame=6, loader_processes=0)
    training = BackboneTraining(config, DrawnGrasping(encoding), 5, "cpu")
    (_, labels), *_ = training._batches()
    drawn_with = {
        name: ExampleStream(DrawnGrasping(name), 5, 12, 6)[0][1] for name in ("double", "paper")
    }
    assert not torch.equal(drawn_with["double"], drawn_with["paper"])
    assert torch.equal(labels[0], drawn_with[encoding])
    # The paper's angles lie in the right half-plane, doubled ones everywhere.
    assert (labels[..., 2].min() >= 0) == (encoding == "paper")


@pytest.mark.parametrize("encoding", ["double", "paper"])
def test_the_score_agrees_with_numpy(encoding: AngleEncoding) -> None:
    task = GraspTask(encoding)
    plan = plan_crops((480, 640), (320, 240), np.random.default_rng(1), 60)
    labels = torch.tensor(label_crops(plan, encoding=encoding))[None]
    generator = torch.Generator().manual_seed(0)
    # Layers that pass three features through, so that the features are the raw outputs.
    raw = torch.randn(1, 60, 3, generator=generator)
    start = [(torch.eye(3), torch.zeros(3))]
    tasks = TaskSet(raw[:, :, None].double(), labels, support=20)
    (got,) = score(start_states(start, 1), tasks, task)
    seen = GraspLoss(encoding).activate(raw[0])[20:].numpy()
    positive = labels[0, 20:, 0].numpy() > 0
    predicted = decode_angle(seen[:, 1], seen[:, 2], encoding)
    error = np.degrees(angle_error(predicted, plan.turn_rad[20:]))[positive].mean()
    target = 0.95 * positive + 0.025
    detection = -(target * np.log(seen[:, 0]) + (1 - target) * np.log(1 - seen[:, 0])).mean()
    angle = ((seen - labels[0, 20:].numpy())[positive, 1:] ** 2).sum(axis=1).mean()
    assert got.objective == pytest.approx(detection + np.sqrt(angle + 1e-4), rel=1e-5)
    assert got.scores["detection_accuracy"] == pytest.approx(
        ((seen[:, 0] > 0.5) == positive).mean()
    )
    assert got.scores["angle_mae_deg"] == pytest.approx(error, rel=1e-4)


@pytest.mark.parametrize("encoding", ["double", "paper"])
def test_both_sides_of_the_seam_are_close(encoding: AngleEncoding) -> None:
    seen, true = np.radians([89.0, 10.0]), np.radians([-89.0, 12.0])
    labels = np.concatenate([np.ones((2, 1)), encode_angle(true, encoding)], axis=1)
    channels = torch.tensor(0.9 * encode_angle(seen, encoding))
    cosine = channels[:, 1].atanh() if encoding == "double" else channels[:, 1].logit()
    raw = torch.stack([torch.ones(2), channels[:, 0].atanh(), cosine], dim=1)[None]
    start = [(torch.eye(3), torch.zeros(3))]
    tasks = TaskSet(raw[:, :, None], torch.tensor(labels, dtype=torch.float32)[None], support=0)
    (got,) = score(start_states(start, 1), tasks, GraspTask(encoding))
    assert got.scores["angle_mae_deg"] == pytest.approx(2.0, abs=1e-2)


def test_no_rates_are_best_when_every_run_diverged() -> None:
    scores = {(rate,): Score(float("nan"), {}) for rate in (1.0, 2.0)}
    with pytest.raises(QsgmError, match=r"all 2 trial runs .* diverged; pass another --seed"):
        best_rates(scores)


def test_the_best_rates_are_those_with_the_lowest_finite_objective() -> None:
    losses = {(1.0,): 3.0, (2.0,): float("nan"), (3.0,): 2.0}
    assert best_rates({rates: Score(loss, {}) for rates, loss in losses.items()}) == (3.0,)


def test_of_rates_that_do_as_well_the_first_are_taken() -> None:
    scores = {(1.0,): 2.05, (2.0,): 2.015, (3.0,): 2.0, (4.0,): 2.01}
    assert best_rates({rates: Score(value, {}) for rates, value in scores.items()}) == (2.0,)


def test_recorded_examples_hold_true_gradients_and_an_sgm_learns_them() -> None:
    torch.manual_seed(0)
    net, task = ConvNet(GRASPNET).eval(), DrawnGrasping()
    tasks = draw_tasks(net, task, 2, 80, 9, lambda: None, last_frozen=3)
    start = folded_start(net, 3)
    config = MatchingConfig(epochs=1, record_every=1, fit_steps=150, fit_batch=64)
    examples = record_examples(tasks, start, (0.0, 0.0, 0.0), task, config, seed=0)
    rows = torch.randperm(64, generator=torch.Generator().manual_seed(0))[:32]
    states = start_states(start, 2)
    features, labels = tasks.features[:, rows].float(), tasks.labels[:, rows]
    true = true_gradients(GRASPNET, states, features, labels, task.heads)
    torch.testing.assert_close(examples[5].labels[:64], labels.flatten(0, 1))
    torch.testing.assert_close(examples[5].gradients[:64], true[5].flatten(0, 1))
    sgm = fit_sgm(Sgm(GRASPNET, 5, (32,)), examples[5], config, 0, lambda: None)
    given = sgm(examples[5].activations.transpose(1, 2)[..., None], examples[5].labels)
    alike = torch.nn.functional.cosine_similarity(
        given.flatten(), examples[5].gradients.flatten(), dim=0
    )
    assert alike > 0.9


def test_without_a_positive_there_is_no_angle_to_be_wrong() -> None:
    scores = GraspTask().scores(np.full((4, 3), 0.2, np.float32), np.zeros((4, 3), np.float32))
    assert scores["detection_accuracy"] == 1
    assert np.isnan(scores["angle_mae_deg"])
