"""Episodes, the crops cut from their scenes, and what is made of them."""

import numpy as np
import pytest
import torch
from losses import GraspLoss

from qsgm.grasp.evidence import NAMES
from qsgm.grasp.network import GRASPNET
from qsgm.grasp.task import GraspTask
from qsgm.train.grasp.decision import DecisionConfig, JudgedScene, Weighed, best_score, fit_decision
from qsgm.train.grasp.decision_scenes import heatmap_of
from qsgm.train.grasp.episodes import EpisodeMaker
from qsgm.train.model.fold import folded_start
from qsgm.train.model.net import ConvNet, as_seen
from qsgm.train.pretraining.tasks import start_states


@pytest.fixture(scope="module")
def maker() -> EpisodeMaker:
    return EpisodeMaker(3, tables=2, others=12)


def test_an_episode_depends_on_its_number_and_seed_only(maker: EpisodeMaker) -> None:
    one, again = maker.draw(5, 1), EpisodeMaker(3, tables=2, others=12).draw(5, 1)
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


def made_up_scenes() -> list[JudgedScene]:
    """Two candidates a scene; the object has more of the first piece of evidence."""
    rng, scenes = np.random.default_rng(0), []
    for number in range(300):
        center = (100.0, 100.0) if number % 2 else None
        facts = rng.normal(size=(2, len(NAMES))).astype(np.float32)
        facts[0, 0] += 8.0 * (center is not None)
        places = ((100.0, 103.0), (300.0, 200.0))
        found = tuple(Weighed(fact, place) for fact, place in zip(facts, places, strict=True))
        scenes.append(JudgedScene(number // 4, center, found))
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
    net, task = ConvNet(GRASPNET).eval(), GraspTask()
    frame = np.random.default_rng(0).integers(0, 255, (176, 160, 3)).astype(np.uint8)
    with torch.no_grad():
        raw = net(as_seen(GRASPNET, torch.from_numpy(frame[None])))
        expected = GraspLoss().activate(raw)[0].numpy()
    states = start_states(folded_start(net, 3), 1)
    got = heatmap_of(net, states, frame, heads=task.heads)
    assert got.shape == (3, 4, 3)
    np.testing.assert_allclose(got, expected, atol=1e-5)
