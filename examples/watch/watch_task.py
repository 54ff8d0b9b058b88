"""Exercises by a watch, which learns from a few repetitions how its wearer does them.

Recordings of ten people are in the package seglearn (BSD); the host does not know one of them.
"""

from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np

from qsgm import Head, Network, RecordedTask, Samples, conv
from qsgm.samples.arrays import read_npz

SETS, LENGTH, HOP = (10, 2, 7), 64, 8  # people, arms, exercises; windows of 2.6 s, every 0.3 s
SEEN = [[-1, 1, 1, 0.3, -0.3, -0.3], [1, 1, 1, 0.3, 0.3, 0.3]]  # left arm mirrored, right one
ONE_HOT = np.eye(SETS[2], dtype=np.float32)
LAYERS = (
    conv(6, 16, (1, 9), stride=(1, 2), padding=(0, 4), pool=(1, 2), pool_stride=(1, 2)),
    conv(16, 32, (1, 5), padding=(0, 2), pool=(1, 2), pool_stride=(1, 2)),
    conv(32, 64, (1, 3), padding=(0, 1), pool=(1, 8)),
    conv(64, SETS[2], relu=False),
)


@dataclass(frozen=True)
class Watch(RecordedTask):
    """A file is a set: `motion` (T, 6), `arm` 0 or 1, and which `exercise`, if it is known."""

    overlap: int = LENGTH // HOP - 1
    left_out: int = 9  # whom the host does not know

    def read(self, path):
        found = read_npz(path, ("motion", "arm", "exercise"))
        seen = as_seen(found["motion"], found["arm"])
        inputs = np.stack([seen[i : i + LENGTH] for i in range(0, len(seen) - LENGTH + 1, HOP)])
        known = ONE_HOT[np.repeat(found.get("exercise", 0), len(inputs))]
        return Samples(inputs[:, None], known if "exercise" in found else None)

    def draw(self, rng, count):  # four fifths are learnt from: the first third of one arm's sets
        (who, arm, kind), later = self.some(rng, count), np.arange(count) >= count * 4 // 5
        share = (rng.random(count) * (1 + later) + later) / 3
        return self.windows(rng, (who[0], np.where(later, arm, arm[0]), kind), share, kind, 0.5)

    def example(self, rng, count):
        return self.windows(rng, self.some(rng, count), rng.random(count), np.arange(count), 0.2)

    def some(self, rng, count):
        who = rng.choice(np.delete(np.arange(SETS[0]), self.left_out), count)
        return who, rng.integers(0, SETS[1], count), rng.integers(0, SETS[2], count)

    def windows(self, rng, which, share, group, most):  # each group turned, hastened in its own way
        (motion, start, length), groups = pool(), range(group.max() + 1)
        turn = np.stack([cv2.Rodrigues(rng.uniform(-most, most, 3))[0] for _ in groups])
        tempo = rng.uniform(0.8, 1.25, len(turn))[group, None]
        at = (start[which] + share * (length[which] - 81))[:, None] + np.arange(LENGTH) * tempo
        seen = motion[at.astype(int)].reshape(-1, LENGTH, 2, 3) @ turn[group][:, None]
        return Samples(seen.reshape(-1, 1, LENGTH, 6).astype(np.float32), ONE_HOT[which[2]])


def as_seen(motion, arm):
    """Motion (T, 6) at 50 Hz as the network sees it, at 25 Hz."""
    return ((motion[:-1:2] + motion[1::2]) / 2 * SEEN[int(arm)]).astype(np.float32)


@lru_cache
def pool():
    """Motion of all sets in a row, then where each begins, and how long it is."""
    file = Path(find_spec("seglearn").origin).parent / "data" / "watch_dataset.npy"
    found = np.load(file, allow_pickle=True).item()
    order = np.lexsort([found["y"], found["side"], found["subject"]])
    sets = [as_seen(found["X"][i], found["side"][i]) for i in order]
    length = np.array([len(one) for one in sets])
    return np.concatenate(sets), (length.cumsum() - length).reshape(SETS), length.reshape(SETS)


HEAD = Head("exercise", "cross_entropy", SETS[2], "softmax", smoothing=0.05)
task = Watch("watch", Network((1, LENGTH, 6), LAYERS, "numbers"), (HEAD,))
