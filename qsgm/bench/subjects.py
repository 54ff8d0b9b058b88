"""Who plays in composed scenes: the objects of a folder of frames, or drawn ones."""

from collections.abc import Sequence

import numpy as np

from qsgm.bench.composing import Subject, kind_of
from qsgm.bench.frames import BenchFrame
from qsgm.train.grasp.objects import OBJECT_KINDS, draw_frame

DRAWN_SUBJECTS = 24
LEAST_ELONGATION = 1.35


def subjects_of(frames: Sequence[BenchFrame]) -> list[Subject]:
    """The frames' objects; one that no manifest names is a kind of its own.

    Raises:
        QsgmError: a frame or its mask is missing or cannot be used.
    """
    return [
        Subject(
            name=frame.name,
            kind=frame.name if frame.object_name is None else kind_of(frame.object_name),
            frame=frame.read(),
            mask=frame.read_mask(),
            elongated=frame.elongated,
            unique=frame.unique,
        )
        for frame in frames
    ]


def drawn_subjects(seed: int, count: int = DRAWN_SUBJECTS) -> list[Subject]:
    """Objects drawn from a seed, every kind in turn."""
    kinds = np.random.default_rng([seed, count]).permutation(OBJECT_KINDS)
    subjects = []
    for i in range(count):
        kind = str(kinds[i % len(kinds)])
        drawn = draw_frame(np.random.default_rng([seed, count, i]), object_kind=kind)
        elongated = drawn.elongation >= LEAST_ELONGATION
        subjects.append(Subject(f"{kind}_{i:02}", kind, drawn.image, drawn.mask, elongated))
    return subjects
