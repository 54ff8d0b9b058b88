"""What was learnt of samples, and answers to them, as tables for people and as JSON for programs.

The keys of the JSON objects are stable: more may be added, none goes or changes its meaning.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from qsgm.tables import number, table
from qsgm.task import Array, Head, Scores, channels_of
from qsgm.tune.report import (
    course_json,
    fidelity_report,
    result_json,
    run_title,
    scores_json,
    seconds_line,
)
from qsgm.tune.result import Result

DIGITS = 4


def learnt_json(result: Result, name: str, output: Path) -> dict[str, Any]:
    """What `qsgm finetune` prints: the keys it always has, `task`, and `scores` by name."""
    task = result.prepared.bundle.manifest.task.name
    count = {"taught": result.prepared.taught, "held_out": len(result.prepared.held_out)}
    scores = {"task": task, "scores": scores_json(result.scores)}
    return result_json(result, name, output) | scores | {"samples": count}


def run_json(result: Result, name: str, output: Path) -> dict[str, Any]:
    """What is kept with the tuned network: :func:`learnt_json` and how the run went."""
    return learnt_json(result, name, output) | course_json(result)


def learnt_report(result: Result, name: str) -> RenderableType:
    """Scores before and after, fidelity, seconds."""
    names = [*result.scores]
    rows = [
        [which, *(scores[one] for one in names)]
        for which, scores in (("untouched", result.untouched), ("tuned", result.scores))
    ]
    heading = f"{len(result.prepared.held_out)} held-out samples"
    columns: list[str | tuple[str, str]] = [heading, *((one, "{:.3f}") for one in names)]
    title, scores = Text(run_title(result, name), style="bold"), table(None, columns, rows)
    return Group(title, scores, fidelity_report(result), seconds_line(result.seconds))


def answers_json(
    name: str, task: str, heads: Sequence[Head], outputs: Array, scores: Scores | None
) -> dict[str, Any]:
    """What `qsgm predict` prints: every sample's outputs by head."""
    return {
        "object": name,
        "task": task,
        "samples": len(outputs),
        "outputs": [_by_head(heads, one) for one in outputs],
        "scores": None if scores is None else scores_json(scores),
    }


def answers_table(
    name: str, heads: Sequence[Head], outputs: Array, scores: Scores | None
) -> RenderableType:
    """A row per sample: a class and how sure it is, or the numbers a head gives."""
    rows = [
        [str(i), *(_told(head, one) for head, one in _heads_of(heads, outputs[i]))]
        for i in range(len(outputs))
    ]
    answers = table(name, ["sample", *(head.name for head in heads)], rows)
    told = [f"{one} {value:.3f}" for one, value in (scores or {}).items() if value is not None]
    return Group(answers, *([Text(", ".join(told))] if told else []))


def _heads_of(heads: Sequence[Head], outputs: Array) -> list[tuple[Head, Array]]:
    """One sample's outputs (L,) by head."""
    return [
        (head, outputs[channels.start : channels.stop])
        for head, channels in zip(heads, channels_of(heads), strict=True)
    ]


def _by_head(heads: Sequence[Head], outputs: Array) -> dict[str, list[float | None]]:
    pairs = _heads_of(heads, outputs)
    return {head.name: [number(value, DIGITS) for value in values] for head, values in pairs}


def _told(head: Head, values: Array) -> str:
    if head.kind == "cross_entropy":
        return f"{int(values.argmax())} ({float(values.max()):.2f})"
    return ", ".join(f"{float(value):.3f}" for value in values)
