"""What a task file defines: a network, its heads, and how samples are read.

from qsgm import Head, Network, SampleTask, Samples, conv

class Mine(SampleTask):
    def read(self, path): ...        # the device's half: a file -> Samples
    def draw(self, rng, count): ...  # the host's half: Samples of one person, style or thing

task = Mine("mine", Network(...), (Head(...),))
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from qsgm.errors import QsgmError
from qsgm.network import Network
from qsgm.samples.lesson import (
    SampleLesson,
    Samples,
    ends_held_out,
    head_scores,
    lesson_of,
)
from qsgm.task import Array, Heads, Scores, output_count

TUNED = 2


@dataclass(frozen=True)
class SampleTask:
    """A task of labelled samples; a task file derives from it and says what is its own.

    Raises:
        QsgmError: the heads do not give as many numbers as the network.
    """

    name: str
    network: Network
    heads: Heads
    # How many of the last layers a device tunes unless told otherwise; as many are meta-trained.
    tuned: int = TUNED

    def __post_init__(self) -> None:
        if output_count(self.heads) != self.network.outputs:
            raise QsgmError(
                f"the heads of {self.name!r} have {output_count(self.heads)} channels, its network "
                f"gives {self.network.outputs}: make them the same"
            )
        if not 1 <= self.tuned <= self.network.depth:
            raise QsgmError(f"{self.name!r} tunes {self.tuned} of {self.network.depth} layers")

    def read(self, path: Path) -> Samples:
        """Samples in a file; labelled ones can be learnt from."""
        raise QsgmError(f"the task {self.name!r} does not say how {path} is read: define `read`")

    def lesson(self, shown: Sequence[Samples], rng: np.random.Generator) -> SampleLesson:
        """What is learnt of the samples shown; a fifth of them are held out."""
        return lesson_of(self, shown, rng)

    def scores(self, outputs: Array, labels: Array) -> Scores:
        """What activated outputs (N, L) are worth beside labels (N, L)."""
        return head_scores(self.heads, outputs, labels)

    def to_json(self) -> dict[str, Any]:
        """What a bundle keeps of it beside its name, network and heads."""
        return {"tuned": self.tuned}

    def draw(self, rng: np.random.Generator, count: int) -> Samples:  # noqa: ARG002
        """Labelled samples of one lesson, as a device may meet one (host only)."""
        raise QsgmError(f"the task {self.name!r} has nothing to pretrain on: define `draw`")

    def example(self, rng: np.random.Generator, count: int) -> Samples:
        """Labelled samples that the network is pretrained on (host only): what is drawn."""
        return self.draw(rng, count)


@dataclass(frozen=True)
class RecordedTask(SampleTask):
    """A task whose files are recordings, and its samples windows of these, in their order.

    At random, every window held out would overlap some that are learnt from; so the end of each
    recording is.
    """

    overlap: int = 0  # how many windows in front of another one reach into it

    def lesson(self, shown: Sequence[Samples], rng: np.random.Generator) -> SampleLesson:  # noqa: ARG002
        """What is learnt of the recordings shown; the last fifth of each is held out."""
        return ends_held_out(self, shown, self.overlap)
