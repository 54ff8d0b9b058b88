"""Teach the comparer on drawn objects: which candidates are the taught thing, and which are not.

One comparer serves every checkpoint, as the drawn things that are negatives do: it sees pictures
alone. `qsgm teach-comparer` makes it (:mod:`qsgm.train.grasp.teach_comparer`), and `qsgm pretrain`
weighs what it says together with all other evidence.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.resources import files

import torch
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
from qsgm.grasp.correlation import NOISE_VARIANCE
from qsgm.progress import Progress, counted
from qsgm.train.grasp.comparer_examples import Examples

_TINY = 1e-3


@dataclass(frozen=True)
class ComparerConfig:
    """The comparer's sizes, and the rates it learns at."""

    channels: tuple[int, ...] = (16, 24, 32, 32)
    hidden: int = 32
    steps: int = 58_000
    batch: int = 256
    of_the_object: int = 96  # in a batch
    peak_rate: float = 3e-3
    weight_decay: float = 0.02


def digest(comparer: Comparer) -> str:
    """SHA-256 of its numbers."""
    return hashlib.sha256(json.dumps(comparer.to_json()).encode()).hexdigest()


@lru_cache(maxsize=1)
def shipped_comparer() -> Comparer:
    """The comparer that comes with this package."""
    text = (files("qsgm.train.grasp") / "comparer.json").read_text(encoding="ascii")
    return Comparer.from_json(json.loads(text), "the shipped comparer")


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
    return Layer(weight.detach().cpu().numpy().copy(), bias.detach().cpu().numpy().copy())


def _light(images: Tensor, solid: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    mean = (images * solid).sum((2, 3), keepdim=True) / size
    around = (images - mean) * solid
    return mean, (around * around).sum((1, 2, 3), keepdim=True) / size + NOISE_VARIANCE


def train_comparer(
    examples: Examples, config: ComparerConfig, seed: int, device: str, watch: Progress
) -> Comparer:
    """Learn from examples.

    Args:
        examples: some of the object, some not.
        config: sizes and rates.
        seed: of everything random; another kind of device gives other numbers.
        device: `cpu` or `cuda`, which holds all examples.
        watch: told about every step.
    """
    torch.manual_seed(seed)
    net = ComparerNet(config.channels, config.hidden).to(device)
    optimizer = torch.optim.AdamW(
        net.parameters(), config.peak_rate, weight_decay=config.weight_decay
    )
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, config.peak_rate, total_steps=config.steps + 1, cycle_momentum=False
    )
    batches = Batches(examples, config, seed, device)
    after_step = counted(watch, "comparer", config.steps)
    for _ in range(config.steps):
        batch = batches.draw()
        loss = F.binary_cross_entropy_with_logits(
            net(batch.taught, batch.seen, batch.solid), batches.truth
        )
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        after_step()
    return net.cpu().frozen()


@dataclass(frozen=True)
class Batch:
    """Images (B, 3, 64, 64) in levels, masks (B, 1, 64, 64) in 0 to 1."""

    taught: Tensor
    seen: Tensor
    solid: Tensor


class Batches:
    """Examples on a device, drawn as often of the object and not of it as told, and varied."""

    def __init__(self, examples: Examples, config: ComparerConfig, seed: int, device: str) -> None:
        self._taught, self._solid, self._seen, self._of, mine = (
            torch.from_numpy(some).to(device)
            for some in (
                examples.taught,
                examples.solid,
                examples.seen,
                examples.of,
                examples.mine,
            )
        )
        self._rows = mine.nonzero()[:, 0], (~mine).nonzero()[:, 0]
        self._sizes = config.of_the_object, config.batch - config.of_the_object
        self._chance = Chance(torch.Generator(device).manual_seed(seed))
        self.truth = torch.cat(
            [torch.full((n,), v) for n, v in zip(self._sizes, (1.0, 0.0), strict=True)]
        ).to(device)

    def draw(self) -> Batch:
        """The next batch, what is of the object first."""
        rows = [
            some[self._chance.whole(len(some), size)]
            for some, size in zip(self._rows, self._sizes, strict=True)
        ]
        return varied(self.of(torch.cat(rows)), self._chance)

    def of(self, rows: Tensor) -> Batch:
        """Examples as they are."""
        of = self._of[rows]
        taught, seen = (
            some.permute(0, 3, 1, 2).float() for some in (self._taught[of], self._seen[rows])
        )
        return Batch(taught, seen, self._solid[of][:, None].float() / 255)


@dataclass(frozen=True)
class Chance:
    """Random tensors on a generator's device."""

    generator: torch.Generator

    def between(self, low: float, high: float, *shape: int) -> Tensor:
        """Even."""
        drawn = torch.rand(shape, generator=self.generator, device=self.generator.device)
        return low + (high - low) * drawn

    def normal(self, *shape: int) -> Tensor:
        """Of deviation 1."""
        return torch.randn(shape, generator=self.generator, device=self.generator.device)

    def whole(self, below: int, count: int = 1) -> Tensor:
        """Numbers (N,) from 0 on."""
        return torch.randint(
            below, (count,), generator=self.generator, device=self.generator.device
        )

    def order(self, count: int) -> Tensor:
        """A permutation (N,)."""
        return torch.randperm(count, generator=self.generator, device=self.generator.device)

    def happens(self, rate: float) -> bool:
        """Whether something does that does as often as this."""
        return bool(self.between(0, 1) < rate)


# How often a batch is in negative colours; of its views, how many are covered, or blurred.
_NEGATIVE, _COVERED, _BLURRED = 0.3, 0.3, 0.15


def varied(batch: Batch, chance: Chance) -> Batch:
    """The same comparisons, of other things: turned, in other colours, other light, half hidden."""
    quarter, mirrored = int(chance.whole(4)), chance.happens(0.5)

    def laid(images: Tensor) -> Tensor:
        return torch.rot90(images.flip(3) if mirrored else images, quarter, (2, 3))

    order = chance.order(3)
    taught, seen = laid(batch.taught)[:, order], laid(batch.seen)[:, order]
    count = len(seen)
    gain = chance.between(0.6, 1.3, count, 1, 1, 1) * chance.between(0.93, 1.07, count, 3, 1, 1)
    noise = chance.between(0, 4) * chance.normal(*seen.shape) + 2 * chance.normal(count, 1, 1, 1)
    seen = (seen * gain + noise).clamp(0, 255)
    if chance.happens(_NEGATIVE):
        taught, seen = 255 - taught, 255 - seen
    return replace(
        batch, taught=taught, seen=_partly_covered(seen, chance), solid=laid(batch.solid)
    )


def _partly_covered(seen: Tensor, chance: Chance) -> Tensor:
    """Some views with a part of another one over them, some out of focus."""
    count = len(seen)
    others = seen[chance.order(count)].roll(int(chance.whole(SIDE)), 3)
    blurred = F.avg_pool2d(F.pad(seen, (1, 1, 1, 1), mode="replicate"), 3, 1)
    kind = chance.between(0, 1, count, 1, 1, 1)
    cover = _covers(count, chance) & (kind < _COVERED)
    dull = (kind >= _COVERED) & (kind < _COVERED + _BLURRED)
    return torch.where(cover, others, torch.where(dull, blurred, seen))


def _covers(count: int, chance: Chance) -> Tensor:
    """Regions (N, 1, 64, 64): half planes and ellipses."""
    at = torch.arange(SIDE, device=chance.generator.device) - (SIDE - 1) / 2
    reach = (SIDE - 1) / 2
    turn, x, y, edge, wide, high = (
        chance.between(low, high, count, 1, 1)
        for low, high in (
            (0, 2 * torch.pi),
            (-reach, reach),
            (-reach, reach),
            (4, 26),
            (5, 18),
            (5, 18),
        )
    )

    def across(angle: Tensor) -> Tensor:
        return angle.cos() * at[None, None] + angle.sin() * at[None, :, None]

    def off_middle(angle: Tensor) -> Tensor:
        return across(angle) - angle.cos() * x - angle.sin() * y

    round_ = (off_middle(turn) / wide) ** 2 + (off_middle(turn + torch.pi / 2) / high) ** 2 < 1
    plane = across(turn) > edge
    return torch.where(chance.between(0, 1, count, 1, 1) < 0.5, plane, round_)[:, None]
