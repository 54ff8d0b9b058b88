"""Seconds per stage of the whole job, in processes of their own, next to the same job in torch.

Every variant runs several times, in turns, so that whatever else the machine does hits all of
them; medians are reported. Single steps and forward passes, too short for that, take turns in one
process a few hundred times, next to those of other frameworks (:mod:`qsgm.bench.peers_table`).
Ratios are what can be compared between machines.
"""

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from rich.console import Group, RenderableType

from qsgm import defaults
from qsgm.bench.peers_table import (
    OWN_STEP,
    OWN_STEPS,
    StepPlan,
    StepTimes,
    measure_steps,
    render_steps,
    steps_json,
)
from qsgm.bench.step_jobs import check_steps
from qsgm.bundle import Bundle
from qsgm.errors import QsgmError
from qsgm.grasp.crops import TRAIN_CROPS
from qsgm.tune.loop import BATCH
from qsgm.tune.prepare import Watch
from qsgm.tune.report import number, plain_table
from qsgm.tune.settings import Settings, trunk_precision

VARIANTS: Mapping[str, Sequence[str]] = {
    "sgm int8": ("--method", "sgm", "--int8"),
    "sgm float": ("--method", "sgm", "--float"),
    "bp": ("--method", "bp"),
}
TORCH = "torch bp"
STAGES = ("crops", "features", "tuning", "total", "process")

Seconds = dict[str, float]


def measure_speed(
    frame: Path,
    bundle: Bundle,
    settings: Settings,
    repeats: int,
    watch: Watch,
    plan: StepPlan = OWN_STEPS,
) -> dict[str, Any]:
    """Medians of all variants and the ratios between them; torch where it is installed.

    `plan` says which other frameworks' steps to measure; without one, none.
    """
    check_steps(bundle, settings.layers)
    medians = measure_jobs(frame, bundle, settings, repeats, watch)
    times = measure_steps(frame, bundle, settings.layers, settings.threads, repeats, plan, watch)
    steps = settings.epochs * -(-TRAIN_CROPS // BATCH)
    turns = times.own[settings.threads]
    return {
        "frame": str(frame),
        "bundle": str(bundle.folder),
        "layers": settings.layers,
        "trunk": trunk_precision(settings, bundle),
        "epochs": settings.epochs,
        "threads": settings.threads,
        "repeats": repeats,
        "steps": steps,
        "seconds": {
            name: {stage: number(value, 4) for stage, value in stages.items()}
            for name, stages in medians.items()
        },
        "step_ms": {
            name: number(1000 * stages["tuning"] / steps, 4) for name, stages in medians.items()
        },
        "in_turns_ms": {name: number(1000 * value, 4) for name, value in turns.items()},
        "ratios": ratios(medians, turns) | peer_ratios(times, settings.threads),
        **steps_json(times),
    }


def measure_jobs(
    frame: Path, bundle: Bundle, settings: Settings, repeats: int, watch: Watch
) -> dict[str, Seconds]:
    """Median seconds per stage of whole jobs, by variant."""
    with_torch = all(importlib.util.find_spec(name) for name in ("torch", "onnx"))
    variants = [*VARIANTS, TORCH] if with_torch else [*VARIANTS]
    runs: dict[str, list[Seconds]] = {name: [] for name in variants}
    for repeat in range(repeats):
        for done, name in enumerate(variants, start=1):
            runs[name].append(run_once(name, frame, bundle, settings))
            watch("runs", repeat * len(variants) + done, repeats * len(variants))
    return {
        name: {stage: median(run[stage] for run in some) for stage in STAGES}
        for name, some in runs.items()
    }


def ratios(medians: Mapping[str, Seconds], turns: Seconds) -> dict[str, float | None]:
    """Between whole jobs, and between steps and forward passes that took turns.

    `qsgm` is what `qsgm finetune` does unless it is told otherwise.
    """
    own, step = medians[f"sgm {defaults.PRECISION}"], turns[OWN_STEP]
    found = {
        "qsgm_step_over_forward": step / turns["forward"],
        "float_step_over_forward": turns["sgm_float"] / turns["forward"],
        "int8_step_over_forward": turns["sgm_int8"] / turns["forward"],
        "int8_step_over_float_step": turns["sgm_int8"] / turns["sgm_float"],
        "bp_step_over_qsgm_step": turns["backprop"] / step,
        "qsgm_tuning_over_total": own["tuning"] / own["total"],
    }
    if TORCH in medians:
        other = medians[TORCH]
        found |= {
            "torch_bp_step_over_qsgm_step": other["tuning"] / own["tuning"],
            "torch_features_over_qsgm_features": other["features"] / own["features"],
            "torch_process_over_qsgm_process": other["process"] / own["process"],
        }
    return {name: number(value, 3) for name, value in found.items()}


def peer_ratios(times: StepTimes, threads: int) -> dict[str, float | None]:
    """Each other framework's step over this one's, all of SGD."""
    steps = times.seconds(threads)
    return {
        f"{name}_step_over_qsgm_step": number(steps[name] / steps[OWN_STEP], 3)
        for name in steps
        if name not in times.own[threads]
    }


def run_once(
    name: str, frame: Path, bundle: Bundle, settings: Settings, launcher: Sequence[str] = ("-m",)
) -> Seconds:
    """One variant in a process of its own: its stages' seconds, and the process's from outside.

    `launcher` is what Python gets before the module and its arguments.
    """
    folder = bundle.folder.resolve()
    layers, epochs, seed, threads = (
        str(value) for value in (settings.layers, settings.epochs, settings.seed, settings.threads)
    )
    with tempfile.TemporaryDirectory() as home:
        if name == TORCH:
            job = ["qsgm.train.torchjob", str(frame), str(folder), layers, epochs, seed, threads]
        else:
            job = ["qsgm.cli", "finetune", "--json", "-o", f"{home}/object", *VARIANTS[name]]
            job += ["--layers", layers, "--epochs", epochs, "--seed", seed, "--threads", threads]
            job += ["--trunk", trunk_precision(settings, bundle), "--bundle", str(folder)]
            job += ["--", str(frame)]
        began = time.perf_counter()
        done = subprocess.run(
            [sys.executable, *launcher, *job],
            capture_output=True,
            text=True,
            check=False,
            env=os.environ | {"XDG_DATA_HOME": home, "OMP_NUM_THREADS": threads},
        )
        process = time.perf_counter() - began
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines() or ["no message"]
        raise QsgmError(f"{name} failed with exit code {done.returncode}: {lines[-1]}")
    seconds: Seconds = json.loads(done.stdout)["seconds"]
    return seconds | {"process": process}


def render(report: Mapping[str, Any]) -> RenderableType:
    """Seconds per stage and variant, and the ratios below them."""
    table = plain_table(
        f"seconds, median of {report['repeats']}: last {report['layers']} layers, "
        f"{report['steps']} steps, threads: {report['threads']}"
    )
    table.add_column("")
    for stage in STAGES:
        table.add_column(stage, justify="right")
    table.add_column("ms a step", justify="right")
    for name, stages in report["seconds"].items():
        cells = [f"{stages[stage]:.2f}" for stage in STAGES]
        table.add_row(name, *cells, f"{report['step_ms'][name]:.3f}")
    quotients = plain_table("ratios")
    quotients.show_header = False
    for name, value in report["ratios"].items():
        quotients.add_row(name.replace("_", " "), f"{value:.2f}")
    return Group(table, quotients, render_steps(report))
