"""Episodes, the crops cut from their scenes, and what is made of them."""

import math
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from qsgm.angles import angle_error
from qsgm.grasp.evidence import NAMES
from qsgm.train.backbone import TellApart
from qsgm.train.decision import DecisionConfig, JudgedScene, best_score, fit_decision
from qsgm.train.decision_scenes import heatmap_of
from qsgm.train.drawing.scenes import DrawnScene
from qsgm.train.episodes import HARD, USUAL, EpisodeMaker, scene_crops
from qsgm.train.graspnet import GraspNet, Loss, normalize
from qsgm.train.start import folded_start
from qsgm.train.tasks import start_states


@pytest.fixture(scope="module")
def maker() -> EpisodeMaker:
    return EpisodeMaker(3, HARD, tables=2, others=12)


def test_an_episode_depends_on_its_number_and_seed_only(maker: EpisodeMaker) -> None:
    one, again = maker.draw(5, 1), EpisodeMaker(3, HARD, tables=2, others=12).draw(5, 1)
    other = maker.draw(6, 1)
    for scene, same in ((one.demonstration, again.demonstration), (one.scenes[0], again.scenes[0])):
        np.testing.assert_array_equal(scene.image, same.image)
    assert not np.array_equal(one.demonstration.image, other.demonstration.image)


def test_scenes_come_with_the_object_and_without_it(maker: EpisodeMaker) -> None:
    episode = maker.draw(0, 3, without=True)
    assert len(episode.scenes) == len(episode.without) == 3
    for scene in episode.scenes:
        assert scene.center_px is not None
        assert scene.hidden_share < 0.4
        x, y = scene.center_px
        near = scene.mask[int(y) - 60 : int(y) + 60, int(x) - 60 : int(x) + 60]
        assert near.sum() == scene.mask.sum() > 0
    # Another thing may lie in its place; then that is what the mask shows.
    assert episode.demonstration.center_px == (320, 240)


def test_usual_scenes_are_easier_than_hard_ones() -> None:
    assert np.mean(USUAL.crowds) < np.mean(HARD.crowds)
    assert USUAL.structures[0] > HARD.structures[0]
    for name in ("other_distance", "tilt", "hidden", "dim", "blurred"):
        assert getattr(USUAL, name) < getattr(HARD, name)


def bar_scene(turn_rad: float, center_px: tuple[float, float]) -> DrawnScene:
    """A white bar on black, turned counter-clockwise, and a gray disk elsewhere."""
    image = np.zeros((480, 640, 3), np.uint8)
    along = 45 * np.array([math.cos(turn_rad), -math.sin(turn_rad)])
    ends = [np.rint(np.array(center_px) + sign * along).astype(int).tolist() for sign in (-1, 1)]
    cv2.line(image, ends[0], ends[1], (255, 255, 255), 14)
    mask, others = image[..., 0] > 0, np.zeros((480, 640), np.uint8)
    cv2.circle(others, (500, 380), 20, 1, cv2.FILLED)
    image[others > 0] = 90
    return DrawnScene(image, center_px, turn_rad, mask, others > 0, 0.0)


def axis_of(crop: NDArray[np.uint8]) -> float:
    moments = cv2.moments((crop[..., 0] > 160).astype(np.uint8), binaryImage=True)
    return -0.5 * math.atan2(2 * moments["mu11"], moments["mu20"] - moments["mu02"])


def test_a_scenes_crops_are_turned_as_much_as_their_plan_says_since_the_demonstration() -> None:
    scene, demonstration = bar_scene(0.9, (250, 200)), bar_scene(-0.4, (320, 240))
    crops, plan = scene_crops(scene, demonstration, np.random.default_rng(0), 60)
    on = np.flatnonzero(plan.quality)
    seen = np.array([axis_of(crop) for crop in crops[on]])
    error = angle_error(seen, plan.turn_rad[on].astype(np.float64) - 0.4)
    assert np.median(error) < np.radians(2)
    assert len(on) == 30


def test_half_of_a_scenes_negatives_look_at_other_things() -> None:
    scene = bar_scene(0.9, (250, 200))
    _, plan = scene_crops(scene, scene, np.random.default_rng(0), 400)
    off = plan.center_px[plan.quality == 0]
    on_disk = np.hypot(*(off - (500, 380)).T) < 12
    assert 0.4 < on_disk.mean() < 0.62
    assert np.hypot(*(off - (250, 200)).T).min() >= 28


def test_telling_apart_is_ridge_regression_on_the_first_half_judged_on_the_second() -> None:
    rng = np.random.default_rng(0)
    features, mine = rng.normal(size=(3, 12, 5)), rng.integers(0, 2, (3, 12)).astype(float)
    features[..., 0] += 2 * mine
    module = TellApart().double()
    with torch.no_grad():
        module.log_ridge.fill_(math.log(0.7))
    got = float(module(torch.from_numpy(features), torch.from_numpy(mine)).detach())
    losses = []
    for plain, y in zip(features, mine, strict=True):
        x = np.concatenate([plain, np.ones((12, 1))], axis=1)
        rows = np.concatenate([x[:6], math.sqrt(0.7) * np.eye(6)])
        weights = np.linalg.lstsq(rows, np.concatenate([2 * y[:6] - 1, np.zeros(6)]), rcond=None)[0]
        logits = 4 * x[6:] @ weights
        losses += list(np.log1p(np.exp(-np.where(y[6:] > 0, logits, -logits))))
    assert got == pytest.approx(np.mean(losses), rel=1e-9)


def made_up_scenes() -> list[JudgedScene]:
    """Two candidates a scene; the object has more of the first piece of evidence."""
    rng, scenes = np.random.default_rng(0), []
    for number in range(300):
        center = (100.0, 100.0) if number % 2 else None
        facts = rng.normal(size=(2, len(NAMES))).astype(np.float32)
        facts[0, 0] += 5.0 * (center is not None)
        places = ((100.0, 103.0), (300.0, 200.0))
        found = tuple(
            SimpleNamespace(evidence=fact, center_px=place)
            for fact, place in zip(facts, places, strict=True)
        )
        scenes.append(JudgedScene(number // 4, center, found))  # type: ignore[arg-type]
    return scenes


def test_the_decision_finds_what_the_evidence_shows_and_raises_few_false_alarms() -> None:
    scenes = made_up_scenes()
    decision = fit_decision(scenes, DecisionConfig(hidden=4, steps=200, folds=3), 0)
    best = np.array([best_score(decision, scene) for scene in scenes]) > decision.threshold
    there = np.array([scene.center_px is not None for scene in scenes])
    assert best[there].mean() > 0.95
    assert best[~there].mean() < 0.05


def test_a_heatmap_by_folded_layers_is_the_networks_own() -> None:
    torch.manual_seed(0)
    net, loss = GraspNet().eval(), Loss()
    frame = np.random.default_rng(0).integers(0, 255, (176, 160, 3)).astype(np.uint8)
    with torch.no_grad():
        expected = loss.activate(net(normalize(torch.from_numpy(frame[None]))))[0].numpy()
    states = start_states(folded_start(net, 3), 1)
    got = heatmap_of(net, states, frame, loss)
    assert got.shape == (3, 4, 3)
    np.testing.assert_allclose(got, expected, atol=1e-5)
