"""What the comparer learns from: what lay at places in drawn scenes, and whether it was the thing.

Objects drawn anew are looked for in scenes with them and without them, as a device does it before
it has learnt anything. What lies at every judged candidate, moved and turned as it was taught, is
an example. A search that went wrong gives none of the object, so that the true pose gives one more.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache, partial

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.correlation import Fit, pyramid_of
from qsgm.grasp.judge import Appearance, judge
from qsgm.grasp.patch import PATCH_PX, cut_patch
from qsgm.train.grasp.drawing.scenes import DrawnScene
from qsgm.train.grasp.episodes import CENTER_PX, Episode, EpisodeMaker, EpisodesConfig
from qsgm.train.processes import InTurn

Image = NDArray[np.uint8]
# (frame) -> heatmap
Look = Callable[[Image], NDArray[np.float32]]

# A candidate this close to the true centre is the object, one further than the other is not;
# nothing is learnt of those between.
ON_OBJECT_PX, OFF_OBJECT_PX = 12.0, 32.0
# From the true pose, alignment starts at each of these.
_SCALES = (0.9, 1.0, 1.12)


@dataclass(frozen=True)
class Examples:
    """N views at candidates' places, of E taught objects."""

    taught: Image  # (E, 64, 64, 3)
    solid: Image  # (E, 64, 64), 255 on the object
    seen: Image  # (N, 64, 64, 3)
    of: NDArray[np.int64]  # (N,) which object each was taken for
    mine: NDArray[np.bool_]  # (N,) whether it is that

    def __len__(self) -> int:
        return len(self.mine)


@dataclass(frozen=True)
class OfOneObject:
    """The views of one taught object."""

    taught: Image  # (64, 64, 3)
    solid: Image  # (64, 64)
    views: tuple[tuple[Image, bool], ...]  # (64, 64, 3) each, and whether it is the object


def draw_examples(
    look: Look,
    config: EpisodesConfig,
    seed: int,
    after_episode: Callable[[], None],
    in_turn: InTurn = map,
) -> Examples:
    """Look for drawn objects, and keep what lay at every candidate.

    Args:
        look: the untouched network's heatmap of a frame.
        config: how many.
        seed: of the objects and scenes.
        after_episode: told about each object.
        in_turn: gives the objects' views in their order; the same ones wherever it works.
    """
    drawn = list[OfOneObject]()
    for one in in_turn(partial(_of_one_object, look, config, seed), range(config.episodes)):
        drawn.append(one)
        after_episode()
    views = [(number, *view) for number, one in enumerate(drawn) for view in one.views]
    return Examples(
        np.stack([one.taught for one in drawn]),
        np.stack([one.solid for one in drawn]),
        np.stack([seen for _, seen, _ in views]),
        np.array([number for number, _, _ in views]),
        np.array([is_object for _, _, is_object in views]),
    )


def _of_one_object(look: Look, config: EpisodesConfig, seed: int, number: int) -> OfOneObject:
    cv2.setNumThreads(1)  # one process a core
    episode = _maker(config, seed).draw(number, config.scenes, without=True)
    appearance = Appearance.of(cut_patch(episode.demonstration.image, CENTER_PX))
    cells = appearance.aligner.cells
    return OfOneObject(
        np.rint(cells.image).astype(np.uint8),
        np.rint(255 * cells.solid).astype(np.uint8),
        tuple(_views(appearance, episode, look)),
    )


@lru_cache(maxsize=1)  # its tables take a second
def _maker(config: EpisodesConfig, seed: int) -> EpisodeMaker:
    return config.maker(seed)


def _views(appearance: Appearance, episode: Episode, look: Look) -> Iterator[tuple[Image, bool]]:
    """What lies at the candidates of all scenes (64, 64, 3), and whether it is the object."""
    for scenes, is_there in ((episode.scenes, True), (episode.without, False)):
        for scene in scenes:  # without it another thing may be where it was
            for one in judge(appearance, scene.image, look(scene.image)):
                center = scene.center_px if is_there else None
                off = math.inf if center is None else math.dist(one.center_px, center)
                if not ON_OBJECT_PX < off < OFF_OBJECT_PX:
                    yield one.seen, off <= ON_OBJECT_PX
    turn = episode.demonstration.turn_rad
    for scene in episode.scenes:
        yield from _at_true_pose(appearance, scene, turn)


def _at_true_pose(
    appearance: Appearance, scene: DrawnScene, taught_turn_rad: float
) -> Iterator[tuple[Image, bool]]:
    """The object as it lies, if alignment stays on it."""
    assert scene.center_px is not None, "the object is in the scene"
    turn, pyramid = scene.turn_rad - taught_turn_rad, pyramid_of(scene.image)
    x, y = (value - (PATCH_PX - 1) / 2 for value in appearance.template.patch.center_px)
    fits = []
    for scale in _SCALES:
        cos, sin = scale * math.cos(turn), scale * math.sin(turn)
        center = scene.center_px[0] - cos * x - sin * y, scene.center_px[1] + sin * x - cos * y
        fits.append(appearance.aligner.aligned(pyramid, Fit(0.0, turn, scale, center)))
    fit, seen = max(fits, key=lambda one: one[0].score)
    if math.dist(appearance.center_of(fit), scene.center_px) <= ON_OBJECT_PX:
        yield seen.picture, True
