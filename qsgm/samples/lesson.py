"""Labelled samples as a lesson, and what a network's answers to them are worth."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from qsgm.errors import QsgmError
from qsgm.network import Network
from qsgm.task import (
    Array,
    Head,
    Inputs,
    Rows,
    Scores,
    Task,
    channels_of,
    label_span,
    output_count,
)

HELD_OUT_SHARE = 0.2
HALF = 0.5


@dataclass(frozen=True)
class Samples:
    """Inputs (N, H, W, C) with their labels (N, L), if they are known."""

    inputs: Inputs
    labels: Array | None = None

    def __len__(self) -> int:
        return len(self.inputs)


@dataclass(frozen=True)
class SampleLesson:
    """A lesson of samples whose labels are known from the start."""

    task: Task
    inputs: Inputs
    labels: Array
    taught: int  # those behind them are held out

    def __len__(self) -> int:
        return len(self.labels)

    def cut(self, rows: Rows) -> Inputs:
        return self.inputs[rows]

    def labelled(self, untouched: Array) -> "SampleLesson":  # noqa: ARG002 (labels are known)
        return self

    def scores(self, outputs: Array, rows: Rows) -> Scores:
        return self.task.scores(outputs, self.labels[rows])


def lesson_of(task: Task, shown: Sequence[Samples], rng: np.random.Generator) -> SampleLesson:
    """All samples in a random order, a fifth of them held out.

    Raises:
        QsgmError: there are fewer than two, or some have no labels.
    """
    labels = [one.labels for one in shown if one.labels is not None]
    if len(labels) < len(shown) or not shown:
        raise QsgmError("samples to learn from need labels; pass labelled ones")
    total = sum(len(one) for one in shown)
    if total < 2:
        raise QsgmError(f"{total} sample is none to learn from and one to check on; pass more")
    order = rng.permutation(total)
    held_out = max(1, round(HELD_OUT_SHARE * total))
    inputs = np.concatenate([one.inputs for one in shown])[order]
    return SampleLesson(task, inputs, np.concatenate(labels)[order], total - held_out)


def ends_held_out(task: Task, shown: Sequence[Samples], overlap: int) -> SampleLesson:
    """Windows of recordings, the last fifth of each held out.

    Args:
        task: whose samples they are.
        shown: each a recording's windows, in their order.
        overlap: how many in front of those held out take no part, as they reach into them.

    Raises:
        QsgmError: there is no recording, or one has too few windows or no labels.
    """
    if not shown:
        raise QsgmError("nothing was shown to learn from; pass labelled recordings")
    taught, held_out = list[Samples](), list[Samples]()
    for one in shown:
        end = len(one) - max(1, round(HELD_OUT_SHARE * len(one)))
        if one.labels is None or end <= overlap:
            has = "no labels" if one.labels is None else f"{len(one)} windows"
            raise QsgmError(
                f"a recording to learn from has {has}, expected labelled ones, more than the last "
                f"fifth, which is held out, and {overlap} before it; record for longer"
            )
        taught.append(Samples(one.inputs[: end - overlap], one.labels[: end - overlap]))
        held_out.append(Samples(one.inputs[end:], one.labels[end:]))
    parts = [*taught, *held_out]
    inputs = np.concatenate([one.inputs for one in parts])
    labels = np.concatenate([one.labels for one in parts if one.labels is not None])
    return SampleLesson(task, inputs, labels, sum(map(len, taught)))


def head_scores(heads: Sequence[Head], outputs: Array, labels: Array) -> Scores:
    """By head: the share of right answers, or the mean absolute error where it gives numbers.

    None where no sample counts for a head.
    """
    found: dict[str, float | None] = {}
    for head, channels in zip(heads, channels_of(heads), strict=True):
        counts = np.ones(len(labels), bool) if head.where is None else labels[:, head.where] > 0
        answers, known = outputs[counts][:, channels], labels[counts][:, channels]
        name = f"{head.name}_{'error' if head.kind == 'squared' else 'accuracy'}"
        found[name] = _worth(head, answers, known) if counts.any() else None
    return found


def fallen(heads: Sequence[Head], before: Scores, after: Scores) -> tuple[str, ...]:
    """A line for every head's score of :func:`head_scores` that got worse."""
    lines = list[str]()
    for head in heads:
        error = head.kind == "squared"
        name = f"{head.name}_{'error' if error else 'accuracy'}"
        was, now = before.get(name), after.get(name)
        if was is not None and now is not None and not (now <= was if error else now >= was):
            lines.append(
                f"tuning made it worse: held-out {name} {was:.3f} before, {now:.3f} now; show more "
                "samples, or other --epochs or --layers, or keep the untouched network"
            )
    return tuple(lines)


def _worth(head: Head, answers: Array, known: Array) -> float:
    if head.kind == "cross_entropy":
        return float(np.mean(answers.argmax(axis=1) == known.argmax(axis=1)))
    if head.kind == "log_loss":
        return float(np.mean((answers > HALF) == (known > HALF)))
    return float(np.mean(np.abs(answers - known)))


def checked_samples(found: Any, network: Network, heads: Sequence[Head], where: str) -> Samples:
    """Samples that fit a network and its heads.

    Raises:
        QsgmError: says what of `found`, which `where` gave, does not fit.
    """
    if not isinstance(found, Samples):
        raise QsgmError(f"{where} gives a {type(found).__name__}, expected qsgm.Samples")
    dtype = np.dtype(np.uint8 if network.input_kind == "pixels" else np.float32)
    inputs, labels = found.inputs, found.labels
    got = f"{getattr(inputs, 'dtype', type(inputs).__name__)} {getattr(inputs, 'shape', '')}"
    fits = isinstance(inputs, np.ndarray) and inputs.dtype == dtype and inputs.ndim == 4
    if not (fits and inputs.shape[1:] == network.input_shape and len(inputs) > 0):
        expected = ", ".join(map(str, network.input_shape))
        raise QsgmError(f"{where}: samples are {got}, expected {dtype} (N, {expected})")
    if not np.isfinite(inputs).all():
        raise QsgmError(f"{where}: samples hold NaN or infinity, expected finite numbers")
    if labels is not None:
        _check_labels(labels, len(inputs), heads, where)
    return found


def _check_labels(labels: Array, count: int, heads: Sequence[Head], where: str) -> None:
    got = f"{getattr(labels, 'dtype', type(labels).__name__)} {getattr(labels, 'shape', '')}"
    shape = (count, output_count(heads))
    if getattr(labels, "dtype", None) != np.float32 or labels.shape != shape:
        raise QsgmError(f"{where}: labels are {got}, expected float32 {shape}")
    low, high = label_span(heads)
    if not ((labels >= low) & (labels <= high)).all():  # NaN is in no range
        spans = ", ".join(f"{head.name} from {head.label_low:g} to 1" for head in heads)
        raise QsgmError(f"{where}: labels lie outside of what the heads give: {spans}")
