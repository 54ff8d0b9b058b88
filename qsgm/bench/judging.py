"""Answers to scenes, judged: where they point, how well quality tells presence, how sure that is.

With the object in the scene an answer is the right place (found, within 24 px of the true
centre), a wrong thing (found on another thing), background (found on neither) or missed. Without
it, whatever is found is a false alarm. Intervals are bootstrapped over pairs of scenes.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from qsgm.bench.composing import Condition, Scene, Subject
from qsgm.bench.cutouts import Mask, Point

# A detection this close to the true centre is one of the object.
ON_OBJECT_PX = 24.0
# A detection this close to another thing's pixels is one of that thing.
ON_THING_PX = 4
FALSE_ALARM_RATE = 0.02
RESAMPLES = 1000
OUTCOMES = (
    "right_place",
    "wrong_thing",
    "background",
    "missed",
    "false_alarm",
    "false_alarm_thing",
    "false_alarm_background",
)

Spot = Literal["object", "thing", "background"]
Outcome = Literal["right_place", "wrong_thing", "background", "missed", "false_alarm", "quiet"]
Flags = NDArray[np.bool_]
Numbers = NDArray[np.float64]


@dataclass(frozen=True)
class Answer:
    """What a method says of a scene; not found, the rest is its best guess."""

    found: bool
    quality: float  # the higher, the surer; minus infinity: no guess at all
    center_px: Point
    turn_deg: float  # since the demonstration, counter-clockwise, modulo 180
    full_turn_deg: float | None = None  # over the full circle, where the method tells
    seconds: float | None = None
    refined: bool | None = None  # False: by the fallback only; None: the method has none


@dataclass(frozen=True)
class Truth:
    """What is true of a scene, and of the object that is looked for."""

    frame: str
    condition: Condition
    number: int  # of the pair among those of its frame and condition
    center_px: Point | None  # None: the object is not there
    turn_deg: float
    scale: float
    absent_thing: bool
    elongated: bool | None
    unique: bool | None

    @property
    def present(self) -> bool:
        return self.center_px is not None


@dataclass(frozen=True)
class Judged:
    """An answer, and what it points at."""

    truth: Truth
    answer: Answer
    spot: Spot

    @property
    def outcome(self) -> Outcome:
        """What the answer is worth."""
        if not self.truth.present:
            return "false_alarm" if self.answer.found else "quiet"
        if not self.answer.found:
            return "missed"
        outcomes: dict[Spot, Outcome] = {
            "object": "right_place",
            "thing": "wrong_thing",
            "background": "background",
        }
        return outcomes[self.spot]

    @property
    def center_error_px(self) -> float:
        """Distance of the best guess from the true centre; infinite where there is no object."""
        if self.truth.center_px is None:
            return math.inf
        return math.dist(self.answer.center_px, self.truth.center_px)

    @property
    def turn_error_deg(self) -> float:
        """Modulo 180 degrees, in [0, 90]."""
        return abs((self.answer.turn_deg - self.truth.turn_deg + 90) % 180 - 90)

    @property
    def full_turn_error_deg(self) -> float | None:
        """Over the full circle, in [0, 180]; None where the method does not tell."""
        if self.answer.full_turn_deg is None:
            return None
        return abs((self.answer.full_turn_deg - self.truth.turn_deg + 180) % 360 - 180)


def truth_of(subject: Subject, scene: Scene, number: int, absent_thing: bool) -> Truth:
    """What is true of a scene of a subject."""
    return Truth(
        subject.name,
        scene.condition,
        number,
        scene.center_px,
        math.degrees(scene.turn_rad),
        scene.scale,
        absent_thing,
        subject.elongated,
        subject.unique,
    )


def judge(truth: Truth, answer: Answer, others: Mask) -> Judged:
    """Where an answer points; `others` (H, W) are the pixels of other things."""
    if truth.center_px is not None and math.dist(answer.center_px, truth.center_px) <= ON_OBJECT_PX:
        return Judged(truth, answer, "object")
    return Judged(truth, answer, "thing" if _near(others, answer.center_px) else "background")


@dataclass(frozen=True)
class Tally:
    """Arrays of n pairs of scenes; columns: with the object, without it."""

    found: Flags  # (n, 2)
    quality: Numbers  # (n, 2)
    on_object: Flags  # (n,)
    on_thing: Flags  # (n, 2)

    @staticmethod
    def of(results: Sequence[Judged]) -> "Tally":
        """The pairs among results, whose scenes may come in any order."""
        pairs: dict[tuple[str, str, int], list[Judged]] = {}
        for result in sorted(results, key=lambda result: not result.truth.present):
            truth = result.truth
            pairs.setdefault((truth.frame, truth.condition, truth.number), []).append(result)
        rows = list(pairs.values())
        if any([result.truth.present for result in row] != [True, False] for row in rows):
            raise ValueError("`results` must hold every scene with the object and without it")
        return Tally(
            np.array([[r.answer.found for r in row] for row in rows]).reshape(-1, 2),
            np.array([[r.answer.quality for r in row] for row in rows], float).reshape(-1, 2),
            np.array([row[0].spot == "object" for row in rows], bool),
            np.array([[r.spot == "thing" for r in row] for row in rows]).reshape(-1, 2),
        )

    def rows(self, which: NDArray[np.int64]) -> "Tally":
        """Some of the pairs, each as often as named."""
        return Tally(
            self.found[which], self.quality[which], self.on_object[which], self.on_thing[which]
        )

    @property
    def right(self) -> Flags:
        """Pairs (n,) whose object was found in its right place."""
        return self.found[:, 0] & self.on_object


def outcome_shares(tally: Tally) -> dict[str, float]:
    """Share of every outcome; NaN without any pairs."""
    if not len(tally.found):
        return dict.fromkeys(OUTCOMES, math.nan)
    found, alarm = tally.found.T
    elsewhere = found & ~tally.on_object
    return {
        "right_place": float(tally.right.mean()),
        "wrong_thing": float((elsewhere & tally.on_thing[:, 0]).mean()),
        "background": float((elsewhere & ~tally.on_thing[:, 0]).mean()),
        "missed": float((~found).mean()),
        "false_alarm": float(alarm.mean()),
        "false_alarm_thing": float((alarm & tally.on_thing[:, 1]).mean()),
        "false_alarm_background": float((alarm & ~tally.on_thing[:, 1]).mean()),
    }


def shares(tally: Tally) -> dict[str, float]:
    """Share of every outcome, and how well quality tells presence; NaN without any pairs.

    A best guess that is not on the object counts as no sign of it, however high its quality.
    """
    if not len(tally.found):
        return dict.fromkeys((*OUTCOMES, "roc_area", "equal_error_rate"), math.nan)
    hits = np.where(tally.on_object, tally.quality[:, 0], -np.inf)
    return outcome_shares(tally) | {
        "roc_area": roc_area(hits, tally.quality[:, 1]),
        "equal_error_rate": equal_error_rate(hits, tally.quality[:, 1]),
    }


def errors(results: Sequence[Judged]) -> dict[str, float]:
    """Errors of right places: centre, turn of elongated objects, way round of unique ones.

    And the share of them where the refinement's fallback ran.
    """
    right = [result for result in results if result.outcome == "right_place"]
    turns = [r.turn_error_deg for r in right if r.truth.elongated is not False]
    full = [r.full_turn_error_deg for r in right if r.truth.unique]
    ways = [error < 90 for error in full if error is not None]
    fallbacks = [not r.answer.refined for r in right if r.answer.refined is not None]
    return {
        "median_center_error_px": _median([result.center_error_px for result in right]),
        "median_turn_error_deg": _median(turns),
        "full_turn_right": float(np.mean(ways)) if ways else math.nan,
        "fallback": float(np.mean(fallbacks)) if fallbacks else math.nan,
    }


def roc_area(positives: Numbers, negatives: Numbers) -> float:
    """Probability that a positive is above a negative; ties count half."""
    ordered = np.sort(negatives)
    below = np.searchsorted(ordered, positives, "left")
    not_above = np.searchsorted(ordered, positives, "right")
    return float((below + not_above).mean() / (2 * len(ordered)))


def equal_error_rate(positives: Numbers, negatives: Numbers) -> float:
    """Where misses and false alarms are equally frequent, straight between thresholds."""
    levels = np.unique(np.concatenate([positives, negatives]))[::-1]
    alarms = np.concatenate([[0.0], _share_from(negatives, levels)])
    misses = np.concatenate([[1.0], 1 - _share_from(positives, levels)])
    gap = alarms - misses
    i = int(np.argmax(gap >= 0))
    part = -gap[i - 1] / (gap[i] - gap[i - 1])
    return float(alarms[i - 1] + part * (alarms[i] - alarms[i - 1]))


def threshold_for(negatives: Numbers) -> float:
    """The lowest threshold above which at most 2 % of the negatives lie."""
    if not len(negatives):
        return math.inf
    allowed = min(int(FALSE_ALARM_RATE * len(negatives) + 1e-9), len(negatives) - 1)
    return float(np.sort(negatives)[::-1][allowed])


def intervals(
    tally: Tally,
    seed: int,
    statistics: Callable[[Tally], Mapping[str, float]] = shares,
    resamples: int = RESAMPLES,
) -> dict[str, tuple[float, float]]:
    """Bootstrap 95 % intervals of statistics, resampling pairs of scenes."""
    count = len(tally.found)
    if not count:
        return dict.fromkeys(statistics(tally), (math.nan, math.nan))
    rng = np.random.default_rng(seed)
    drawn = [statistics(tally.rows(rng.integers(count, size=count))) for _ in range(resamples)]
    return {name: _middle_95([values[name] for values in drawn]) for name in drawn[0]}


def paired_difference(
    first: Flags | Numbers, second: Flags | Numbers, seed: int
) -> tuple[float, tuple[float, float]]:
    """Mean of first - second over the same n scenes, with its bootstrap 95 % interval."""
    if first.shape != second.shape or not len(first):
        raise ValueError(f"expected equally many scenes, got {first.shape} and {second.shape}")
    difference = first.astype(float) - second.astype(float)
    rng = np.random.default_rng(seed)
    rows = (rng.integers(len(difference), size=len(difference)) for _ in range(RESAMPLES))
    return float(difference.mean()), _middle_95([difference[row].mean() for row in rows])


def _near(others: Mask, point: Point) -> bool:
    """Whether a pixel of `others` (H, W) lies within :data:`ON_THING_PX`."""
    if not all(math.isfinite(value) for value in point):
        return False
    x, y = (round(value) for value in point)
    reach = ON_THING_PX
    top, left = max(y - reach, 0), max(x - reach, 0)
    rows, cols = np.nonzero(others[top : max(y + reach + 1, 0), left : max(x + reach + 1, 0)])
    return bool((np.hypot(rows + top - y, cols + left - x) <= reach).any())


def _share_from(values: Numbers, levels: Numbers) -> Numbers:
    """Share of the values at or above each level."""
    ordered = np.sort(values)
    return np.asarray(1 - np.searchsorted(ordered, levels, "left") / len(ordered))


def _middle_95(values: Sequence[float]) -> tuple[float, float]:
    low, high = np.percentile(values, [2.5, 97.5])
    return float(low), float(high)


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else math.nan
