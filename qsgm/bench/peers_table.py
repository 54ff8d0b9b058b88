"""The step table: what a training step takes here and in other frameworks, by threads.

Own steps take turns in this process, peers take turns with that in processes of their own, so that
whatever else the machine does hits all of them; medians over the processes are reported.
"""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from qsgm import defaults
from qsgm.bench.peers import PEERS, Peer, PeerRun, run_peer, write_job
from qsgm.bench.step_jobs import step_seconds
from qsgm.bench.tables import right_table
from qsgm.bundle import Bundle
from qsgm.errors import QsgmError
from qsgm.tune.loop import BATCH
from qsgm.tune.prepare import Watch
from qsgm.tune.report import number

# Of each kind of own step, and of a forward pass.
TURNS = 400
OWN_STEP = f"sgm_{defaults.PRECISION}"  # that others are compared with
OWN = {"forward": "forward", "sgm_int8": "sgm int8", "sgm_float": "sgm float", "backprop": "bp"}


@dataclass(frozen=True)
class StepPlan:
    """Which peers' steps to take, and how."""

    thread_counts: tuple[int, ...] = ()  # none: no peer is measured
    interpreters: Mapping[str, Path] = field(default_factory=dict)  # of peers with their own
    peers: tuple[Peer, ...] = PEERS


OWN_STEPS = StepPlan()


@dataclass(frozen=True)
class StepTimes:
    """What was measured, by threads and name."""

    own: dict[int, dict[str, float]]  # seconds, medians
    peers: dict[int, dict[str, list[PeerRun]]] = field(default_factory=dict)
    not_measured: dict[str, str] = field(default_factory=dict)  # peer: why

    def seconds(self, threads: int) -> dict[str, float]:
        """Of all steps with so many threads."""
        runs = self.peers.get(threads, {})
        others = {
            key_of(name): median(run.step_seconds for run in some) for name, some in runs.items()
        }
        return self.own[threads] | others


def key_of(name: str) -> str:
    """A peer's name as a key of the report."""
    return name.replace(" ", "_").replace(".", "_").replace("-", "_")


def measure_steps(
    frame: Path,
    bundle: Bundle,
    layers: int,
    threads: int,
    repeats: int,
    plan: StepPlan,
    watch: Watch,
) -> StepTimes:
    """Own steps with `threads` and with the plan's counts, and the peers' with the plan's."""
    counts = sorted({threads, *plan.thread_counts})
    own: dict[int, list[dict[str, float]]] = {count: [] for count in counts}
    peers = {count: {peer.name: list[PeerRun]() for peer in plan.peers} for count in counts}
    not_measured: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as home:
        job = Path(home, "job.npz")
        asked = plan.peers if plan.thread_counts else ()
        if asked:
            not_measured |= try_to_write(frame, bundle, layers, job, asked)
        for repeat in range(repeats):
            for done, count in enumerate(counts, start=1):
                own[count].append(step_seconds(bundle, layers, TURNS, count))
                some = asked if count in plan.thread_counts else ()
                not_measured |= run_each(some, not_measured, plan, job, count, peers[count])
                watch("steps", repeat * len(counts) + done, repeats * len(counts))
    return StepTimes(
        {count: medians(some) for count, some in own.items()},
        {count: without(runs, not_measured) for count, runs in peers.items()},
        not_measured,
    )


def without(runs: Mapping[str, list[PeerRun]], failed: Mapping[str, str]) -> dict[str, Any]:
    """The runs of the peers that were asked for and never failed."""
    return {name: some for name, some in runs.items() if some and name not in failed}


def medians(turns: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Of every kind of step."""
    return {name: median(turn[name] for turn in turns) for name in turns[0]}


def try_to_write(
    frame: Path, bundle: Bundle, layers: int, job: Path, peers: Sequence[Peer]
) -> dict[str, str]:
    """Write the peers' job, or say for each of them why there is none."""
    try:
        write_job(frame, bundle.folder, layers, job)
    except QsgmError as error:
        why = f"its data could not be made ({error}); they take the extra `train`"
        return {peer.name: why for peer in peers}
    return {}


def run_each(
    peers: Sequence[Peer],
    failed: Mapping[str, str],
    plan: StepPlan,
    job: Path,
    threads: int,
    runs: dict[str, list[PeerRun]],
) -> dict[str, str]:
    """Run once each peer that has not failed yet, adding to `runs`; return why others failed."""
    reasons = {}
    for peer in peers:
        if peer.name in failed:
            continue
        cache = job.parent / f"compiled_{threads}"
        try:
            runs[peer.name].append(run_peer(peer, plan.interpreters, job, threads, cache))
        except QsgmError as error:
            reasons[peer.name] = str(error)
    return reasons


def steps_json(times: StepTimes) -> dict[str, Any]:
    """The report's keys that concern single steps, by threads; times in milliseconds."""
    table = {str(count): times.seconds(count) for count in times.own}
    return {
        "step_table_ms": {
            count: {name: number(1000 * value, 4) for name, value in some.items()}
            for count, some in table.items()
        },
        "step_over_qsgm_step": {
            count: {name: number(value / some[OWN_STEP], 3) for name, value in some.items()}
            for count, some in table.items()
        },
        "peers": {
            str(count): {key_of(name): runs_json(runs) for name, runs in some.items()}
            for count, some in times.peers.items()
        },
        "not_measured": times.not_measured,
    }


def runs_json(runs: Sequence[PeerRun]) -> dict[str, Any]:
    """One peer's processes with one number of threads."""
    first, *others = runs
    again = median(run.setup_seconds for run in others) if others else None
    return {
        "version": first.version,
        "optimizer": first.optimizer,
        "processes": len(runs),
        "steps": min(run.steps for run in runs),
        "step_ms": [number(1000 * run.step_seconds, 4) for run in runs],
        "total_seconds": number(median(run.total_seconds for run in runs), 4),
        "import_seconds": number(median(run.import_seconds for run in runs), 2),
        # Of the first process, which finds nothing compiled.
        "setup_seconds": number(first.setup_seconds, 2),
        "setup_again_seconds": None if again is None else number(again, 2),
        "loss_difference": number(max(run.loss_difference for run in runs), 8),
    }


def render_steps(report: Mapping[str, Any]) -> RenderableType:
    """A row per kind of step, a pair of columns per number of threads; below, what is missing."""
    table = right_table(
        f"a training step, batch {BATCH}: ms, and over the {OWN[OWN_STEP]} step", ""
    )
    table.columns[0].justify, table.columns[0].no_wrap = "left", True
    counts = list(report["step_table_ms"])
    for count in counts:
        for heading in (f"{count} thread{'' if count == '1' else 's'}", "/"):
            table.add_column(heading, justify="right")
    for heading in ("import s", "set-up s"):
        table.add_column(heading, justify="right")
    names = OWN | {key_of(peer.name): peer.name for peer in PEERS}
    for key, name in names.items():
        cells = [cell for count in counts for cell in step_cells(report, count, key)]
        if any(cells):
            table.add_row(name, *cells, *once_cells(report, key))
    reasons = report["not_measured"].items()
    return Group(table, *(Text(f"{name} is not measured: {why}") for name, why in reasons))


def step_cells(report: Mapping[str, Any], count: str, key: str) -> tuple[str, str]:
    """Time and ratio of one kind of step; blank if it was not measured."""
    value = report["step_table_ms"][count].get(key)
    if value is None:
        return "", ""
    return f"{value:.3f}", f"{report['step_over_qsgm_step'][count][key]:.2f}"


def once_cells(report: Mapping[str, Any], key: str) -> list[str]:
    """What a peer's process takes before its steps, with as few threads as were measured."""
    measured = [some[key] for some in report["peers"].values() if key in some]
    names = ("import_seconds", "setup_seconds")
    return [f"{measured[0][name]:.1f}" if measured else "" for name in names]
