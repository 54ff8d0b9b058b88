"""Teach the comparer on drawn objects: which candidates are the taught thing, and which are not.

Objects drawn anew are looked for in scenes with them and without them, as a device does it before
it has learnt anything. What lies at every judged candidate, moved and turned as it was taught, is
an example. A search that went wrong gives none of the object, so that the true pose gives one more.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from qsgm.grasp.cells import SIDE
from qsgm.grasp.comparer import (
    INPUTS,
    KERNEL,
    LAST_SIDE,
    LEAST_GAIN,
    LEVELS,
    MOST_GAIN,
    STRIDES,
    SUMMARIES,
    Comparer,
    Layer,
)
from qsgm.grasp.correlation import NOISE_VARIANCE, Fit, pyramid_of
from qsgm.grasp.judge import Appearance, judge
from qsgm.grasp.patch import PATCH_PX, cut_patch
from qsgm.progress import Progress, counted
from qsgm.train.grasp.drawing.scenes import DrawnScene
from qsgm.train.grasp.episodes import CENTER_PX, OTHERS, TABLES, USUAL, Episode, EpisodeMaker

Image = NDArray[np.uint8]
# (frame) -> heatmap
Look = Callable[[Image], NDArray[np.float32]]

# A candidate this close to the true centre is the object, one further than the other is not;
# nothing is learnt of those between.
ON_OBJECT_PX, OFF_OBJECT_PX = 12.0, 32.0
# From the true pose, alignment starts at each of these.
_SCALES = (0.9, 1.0, 1.12)
_TINY = 1e-3


@dataclass(frozen=True)
class ComparerConfig:
    """How many objects and scenes the comparer learns on, its sizes and rates."""

    episodes: int = 320
    scenes: int = 8  # with the object, and as many without it
    tables: int = TABLES
    others: int = OTHERS  # that lie there
    channels: tuple[int, ...] = (16, 24, 32, 32)
    hidden: int = 32
    passes: int = 10  # over as many examples as there are
    batch: int = 64
    of_the_object: int = 24  # in a batch
    peak_rate: float = 3e-3
    weight_decay: float = 0.02


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


def draw_examples(
    look: Look, config: ComparerConfig, seed: int, after_episode: Callable[[], None]
) -> Examples:
    """Look for drawn objects, and keep what lay at every candidate.

    Args:
        look: the untouched network's heatmap of a frame.
        config: how many.
        seed: of the objects and scenes.
        after_episode: told about each object.
    """
    maker = EpisodeMaker(seed, USUAL, config.tables, config.others)
    taught, solid, seen, of, mine = [], [], list[Image](), list[int](), list[bool]()
    for number in range(config.episodes):
        episode = maker.draw(number, config.scenes, without=True)
        appearance = Appearance.of(cut_patch(episode.demonstration.image, CENTER_PX))
        cells = appearance.aligner.cells
        taught.append(np.rint(cells.image).astype(np.uint8))
        solid.append(np.rint(255 * cells.solid).astype(np.uint8))
        for view, is_object in _views(appearance, episode, look):
            seen.append(view)
            of.append(number)
            mine.append(is_object)
        after_episode()
    return Examples(np.stack(taught), np.stack(solid), np.stack(seen), np.array(of), np.array(mine))


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


class ComparerNet(nn.Module):
    """:class:`qsgm.grasp.comparer.Comparer` as it learns."""

    def __init__(self, channels: Sequence[int], hidden: int) -> None:
        super().__init__()
        into = (INPUTS, *channels[:-1])
        self.convolutions = nn.ModuleList(
            nn.Conv2d(before, after, KERNEL, stride, KERNEL // 2)
            for before, after, stride in zip(into, channels, STRIDES, strict=True)
        )
        self.hidden = nn.Linear(SUMMARIES * channels[-1], hidden)
        self.output = nn.Linear(hidden, 1)

    def forward(self, taught: Tensor, seen: Tensor, solid: Tensor) -> Tensor:
        """Log odds (B,) of images (B, 3, 64, 64) in levels and masks (B, 1, 64, 64) in 0 to 1."""
        size = solid.sum((2, 3), keepdim=True) + _TINY
        mean, spread = _light(taught, solid, size)
        its_mean, its_spread = _light(seen, solid, size)
        gain = (spread / its_spread).sqrt().clamp(LEAST_GAIN, MOST_GAIN)
        own, lit = taught - mean, (seen - its_mean) * gain
        x = torch.cat([own / LEVELS, lit / LEVELS, (lit - own).abs() / LEVELS, 2 * solid - 1], 1)
        for convolution in self.convolutions:
            x = F.relu(convolution(x))
        coarse = F.avg_pool2d(solid, SIDE // LAST_SIDE)
        share = coarse / (coarse.sum((2, 3), keepdim=True) + _TINY)
        summary = torch.cat([(x * share).sum((2, 3)), x.amax((2, 3)), x.mean((2, 3))], 1)
        logits: Tensor = self.output(F.relu(self.hidden(summary)))[:, 0]
        return logits

    def frozen(self) -> Comparer:
        """As a device runs it, weights rounded to 8 bits."""
        layers = [
            _layer(one.get_parameter("weight").permute(2, 3, 1, 0).flatten(0, 2), one)
            for one in self.convolutions
        ]
        layers += [_layer(one.weight.T, one) for one in (self.hidden, self.output)]
        exact = Comparer(tuple(layers[:-2]), *layers[-2:])
        return Comparer.from_json(exact.to_json(), "the comparer")


def _layer(weight: Tensor, module: nn.Module) -> Layer:
    bias = module.get_parameter("bias")
    return Layer(weight.detach().numpy().copy(), bias.detach().numpy().copy())


def _light(images: Tensor, solid: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    mean = (images * solid).sum((2, 3), keepdim=True) / size
    around = (images - mean) * solid
    return mean, (around * around).sum((1, 2, 3), keepdim=True) / size + NOISE_VARIANCE


def train_comparer(
    examples: Examples, config: ComparerConfig, seed: int, watch: Progress
) -> Comparer:
    """Learn from examples.

    Args:
        examples: some of the object, some not.
        config: sizes and rates.
        seed: of everything random.
        watch: told about every step.
    """
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    net = ComparerNet(config.channels, config.hidden)
    steps = max(config.passes * len(examples) // config.batch, 1)
    optimizer = torch.optim.AdamW(
        net.parameters(), config.peak_rate, weight_decay=config.weight_decay
    )
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, config.peak_rate, total_steps=steps + 1
    )
    after_step = counted(watch, "comparer", steps)
    mine, others = np.flatnonzero(examples.mine), np.flatnonzero(~examples.mine)
    for _ in range(steps):
        others_count = config.batch - config.of_the_object
        rows = np.concatenate(
            [rng.choice(mine, config.of_the_object), rng.choice(others, others_count)]
        )
        batch = varied(batch_of(examples, rows), rng)
        truth = torch.from_numpy(examples.mine[rows].astype(np.float32))
        loss = F.binary_cross_entropy_with_logits(net(batch.taught, batch.seen, batch.solid), truth)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        after_step()
    return net.frozen()


@dataclass(frozen=True)
class Batch:
    """Images (B, 3, 64, 64) in levels, masks (B, 1, 64, 64) in 0 to 1."""

    taught: Tensor
    seen: Tensor
    solid: Tensor


def batch_of(examples: Examples, rows: NDArray[np.int64]) -> Batch:
    """Some of the examples."""
    of = examples.of[rows]
    taught, seen = (
        torch.from_numpy(some).permute(0, 3, 1, 2).float()
        for some in (examples.taught[of], examples.seen[rows])
    )
    return Batch(taught, seen, torch.from_numpy(examples.solid[of])[:, None].float() / 255)


# How often a batch is in negative colours; of its views, how many are covered, or blurred.
_NEGATIVE, _COVERED, _BLURRED = 0.3, 0.3, 0.15


def varied(batch: Batch, rng: np.random.Generator) -> Batch:
    """The same comparisons, of other things: turned, in other colours, other light, half hidden."""
    quarter, mirrored = int(rng.integers(4)), bool(rng.random() < 0.5)

    def laid(images: Tensor) -> Tensor:
        return torch.rot90(images.flip(3) if mirrored else images, quarter, (2, 3))

    order = torch.from_numpy(rng.permutation(3))
    taught, seen = laid(batch.taught)[:, order], laid(batch.seen)[:, order]
    count = len(seen)
    gain = rng.uniform(0.6, 1.3, (count, 1, 1, 1)) * rng.uniform(0.93, 1.07, (count, 3, 1, 1))
    noise = rng.uniform(0, 4) * torch.randn(seen.shape) + 2 * torch.randn(count, 1, 1, 1)
    seen = (seen * torch.from_numpy(gain).float() + noise).clamp(0, 255)
    if rng.random() < _NEGATIVE:
        taught, seen = 255 - taught, 255 - seen
    return replace(batch, taught=taught, seen=_partly_covered(seen, rng), solid=laid(batch.solid))


def _partly_covered(seen: Tensor, rng: np.random.Generator) -> Tensor:
    """Some views with a part of another one over them, some out of focus."""
    count = len(seen)
    others = seen[torch.from_numpy(rng.permutation(count))].roll(int(rng.integers(SIDE)), 3)
    blurred = F.avg_pool2d(F.pad(seen, (1, 1, 1, 1), mode="replicate"), 3, 1)
    chance = torch.from_numpy(rng.random((count, 1, 1, 1)))
    cover = torch.from_numpy(_covers(count, rng)) & (chance < _COVERED)
    dull = (chance >= _COVERED) & (chance < _COVERED + _BLURRED)
    return torch.where(cover, others, torch.where(dull, blurred, seen))


def _covers(count: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Regions (N, 1, 64, 64): half planes and ellipses."""
    at = np.arange(SIDE) - (SIDE - 1) / 2
    turn, x, y = rng.uniform(0, 2 * np.pi, count), *rng.uniform(at[0], at[-1], (2, count))
    edge, (wide, high) = rng.uniform(4, 26, count), rng.uniform(5, 18, (2, count))

    def across(angle: NDArray[np.float64]) -> NDArray[np.float64]:
        cos, sin = np.cos(angle)[:, None, None], np.sin(angle)[:, None, None]
        return np.asarray(cos * at[None, None] + sin * at[None, :, None])

    def middle(angle: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.cos(angle) * x + np.sin(angle) * y)[:, None, None]

    beside = turn + np.pi / 2
    along = (across(turn) - middle(turn)) / wide[:, None, None]
    over = (across(beside) - middle(beside)) / high[:, None, None]
    round_ = along**2 + over**2 < 1
    plane = across(turn) > edge[:, None, None]
    return np.where(rng.random((count, 1, 1)) < 0.5, plane, round_)[:, None]
