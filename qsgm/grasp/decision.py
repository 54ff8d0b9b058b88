"""Whether a candidate is the taught object: few pieces of evidence weighed into one quality.

A small network of one hidden layer, trained on drawn scenes with the object and without it
(:mod:`qsgm.train.grasp.decision`). Its threshold is set on whole scenes, for a stated rate of false
alarms, and is part of the quality: from 0.5 on an object counts as found.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qsgm.errors import QsgmError
from qsgm.grasp.cells import Cells
from qsgm.grasp.comparer import Comparer
from qsgm.grasp.evidence import NAMES

Floats = NDArray[np.float32]
# Of drawn scenes without the object. In photographs as many are raised (`docs/results.md`).
FALSE_ALARM_RATE = 0.01
MOST_HIDDEN = 256
# Odds this close to the threshold are worth eight looks instead of one.
_CLOSE = 3.0
# What the comparer says, behind all other evidence.
COMPARED = "compared"


@dataclass(frozen=True)
class Decision:
    """How evidence becomes a quality; F pieces, H hidden units."""

    mean: Floats  # (F,) of the evidence
    deviation: Floats  # (F,)
    hidden: Floats  # (H, F)
    hidden_bias: Floats  # (H,)
    output: Floats  # (H,)
    bias: float
    threshold: float
    comparer: Comparer | None = None  # the last piece of evidence is what it says

    def judged(
        self, cells: Cells, evidence: Floats, seen: NDArray[np.uint8]
    ) -> NDArray[np.float64]:
        """Qualities (N,) of candidates.

        Args:
            cells: of the taught object.
            evidence: (N, F), as :func:`qsgm.grasp.evidence.evidence` has it.
            seen: (N, 64, 64, 3), what lies there, moved and turned as it was taught. What is close
                to the threshold by a glance is compared in all eight ways.
        """
        if self.comparer is None:
            return self.quality(evidence)
        facts = np.column_stack([evidence, self.comparer.logits(cells, seen)])
        close = np.abs(self.score(facts) - self.threshold) < _CLOSE
        if close.any():
            facts[close, -1] = self.comparer.logits_all_ways(cells, seen[close])
        return self.quality(facts)

    def score(self, evidence: Floats) -> NDArray[np.float64]:
        """Log odds of evidence (..., F) coming from the object, before the threshold: (...)."""
        x = (np.asarray(evidence, np.float64) - self.mean) / self.deviation
        units = np.maximum(x @ self.hidden.T.astype(np.float64) + self.hidden_bias, 0.0)
        return np.asarray(units @ self.output.astype(np.float64) + self.bias)

    def quality(self, evidence: Floats) -> NDArray[np.float64]:
        """In (0, 1); from 0.5 on the object counts as found."""
        odds = np.clip(self.score(evidence) - self.threshold, -60.0, 60.0)
        return np.asarray(1 / (1 + np.exp(-odds)))

    def to_json(self) -> dict[str, Any]:
        """What :meth:`from_json` reads; nine digits keep a float32."""
        arrays = {
            name: [float(f"{value:.9g}") for value in np.ravel(getattr(self, name))]
            for name in ("mean", "deviation", "hidden", "hidden_bias", "output")
        }
        comparer = {} if self.comparer is None else {"comparer": self.comparer.to_json()}
        return {
            "evidence": _names(self.comparer is not None),
            **arrays,
            "bias": self.bias,
            "threshold": self.threshold,
            **comparer,
        }

    @staticmethod
    def from_json(values: Mapping[str, Any], where: str) -> "Decision":
        """Read a decision back.

        Raises:
            QsgmError: it weighs other evidence, or its numbers are not what they should be.
        """
        known = values if isinstance(values, Mapping) else {}
        names = _names("comparer" in known)
        if known.get("evidence") != names:
            raise QsgmError(f"{where}: the decision weighs other evidence; {_ADVICE}")
        comparer = Comparer.from_json(values["comparer"], where) if "comparer" in known else None
        try:
            with np.errstate(over="ignore"):  # infinity is refused below
                hidden_bias = np.array(values["hidden_bias"], np.float32)
                hidden = np.array(values["hidden"], np.float32).reshape(
                    len(hidden_bias), len(names)
                )
                decision = Decision(
                    np.array(values["mean"], np.float32).reshape(len(names)),
                    np.array(values["deviation"], np.float32).reshape(len(names)),
                    hidden,
                    hidden_bias,
                    np.array(values["output"], np.float32).reshape(len(hidden_bias)),
                    float(values["bias"]),
                    float(values["threshold"]),
                    comparer,
                )
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise QsgmError(f"{where}: the decision's numbers do not fit; {_ADVICE}") from error
        _check(decision, where)
        return decision


def _names(compares: bool) -> list[str]:
    return [*NAMES, COMPARED] if compares else list(NAMES)


_ADVICE = "make it again with this version of qsgm"


def _check(decision: Decision, where: str) -> None:
    fields = vars(decision).items()
    numbers = [np.ravel(value) for name, value in fields if name != "comparer"]
    sound = all(np.isfinite(value).all() for value in numbers) and (decision.deviation > 0).all()
    if not sound or not 1 <= len(decision.output) <= MOST_HIDDEN:
        raise QsgmError(
            f"{where}: the decision's numbers are not finite or out of range; {_ADVICE}"
        )
