"""Seconds per stage of the whole job, in processes of their own, next to the same job in torch.

Every variant runs several times, in turns, so that whatever else the machine does hits all of
them; medians are reported. Single steps and forward passes, too short for that, take turns in this
process a few hundred times. Ratios are what can be compared between machines.
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
from qsgm.bench.timing import check_steps, step_seconds
from qsgm.bundle import Bundle
from qsgm.errors import QsgmError
from qsgm.grasp.crops import TRAIN_CROPS
from qsgm.progress import Progress
from qsgm.schedule import BATCH
from qsgm.tables import number, numbers, table
from qsgm.tune.settings import Settings

VARIANTS: Mapping[str, Sequence[str]] = {
    "sgm int8": ("--method", "sgm", "--int8"),
    "sgm float": ("--method", "sgm", "--float"),
    "bp": ("--method", "bp"),
}
TORCH = "torch bp"
STAGES = ("crops", "features", "tuning", "total", "process")
TURNS = 400  # of each kind of step, and of a forward pass, in every repeat
OWN_STEP = f"sgm_{defaults.PRECISION}"  # that others are compared with
STEPS = {"forward": "forward", "sgm_int8": "sgm int8", "sgm_float": "sgm float", "backprop": "bp"}

Seconds = dict[str, float]


def measure_speed(
    frame: Path,
    bundle: Bundle,
    settings: Settings,
    repeats: int,
    watch: Progress,
    thread_counts: Sequence[int] = (),
) -> dict[str, Any]:
    """Medians of all variants and the ratios between them; torch where it is installed.

    `thread_counts` are further ones of single steps.
    """
    check_steps(bundle, settings.layers)
    medians = measure_jobs(frame, bundle, settings, repeats, watch)
    counts = sorted({settings.threads, *thread_counts})
    times = measure_steps(bundle, settings.layers, counts, repeats, watch)
    steps = settings.epochs * -(-TRAIN_CROPS // BATCH)
    turns = times[settings.threads]
    return {
        "frame": str(frame),
        "bundle": str(bundle.folder),
        "layers": settings.layers,
        "trunk": settings.trunk or bundle.manifest.trunk,
        "epochs": settings.epochs,
        "threads": settings.threads,
        "repeats": repeats,
        "steps": steps,
        "seconds": {name: numbers(stages, 4) for name, stages in medians.items()},
        "step_ms": {
            name: number(1000 * stages["tuning"] / steps, 4) for name, stages in medians.items()
        },
        "in_turns_ms": in_ms(turns),
        "ratios": ratios(medians, turns),
        "step_table_ms": {str(count): in_ms(some) for count, some in times.items()},
        "step_over_qsgm_step": {
            str(count): {name: number(value / some[OWN_STEP], 3) for name, value in some.items()}
            for count, some in times.items()
        },
    }


def measure_jobs(
    frame: Path, bundle: Bundle, settings: Settings, repeats: int, watch: Progress
) -> dict[str, Seconds]:
    """Median seconds per stage of whole jobs, by variant."""
    variants = variants_here()
    runs: dict[str, list[Seconds]] = {name: [] for name in variants}
    for repeat in range(repeats):
        for done, name in enumerate(variants, start=1):
            runs[name].append(run_once(name, frame, bundle, settings))
            watch("runs", repeat * len(variants) + done, repeats * len(variants))
    return {
        name: {stage: median(run[stage] for run in some) for stage in STAGES}
        for name, some in runs.items()
    }


def variants_here() -> list[str]:
    """All variants of a job; torch's where it is installed."""
    with_torch = all(importlib.util.find_spec(name) for name in ("torch", "onnx"))
    return [*VARIANTS, TORCH] if with_torch else [*VARIANTS]


def measure_steps(
    bundle: Bundle, layers: int, counts: Sequence[int], repeats: int, watch: Progress
) -> dict[int, Seconds]:
    """Median seconds of single steps, by number of threads and variant."""
    turns: dict[int, list[Seconds]] = {count: [] for count in counts}
    for repeat in range(repeats):
        for done, (count, some) in enumerate(turns.items(), start=1):
            some.append(step_seconds(bundle, layers, TURNS, count))
            watch("steps", repeat * len(counts) + done, repeats * len(counts))
    return {
        count: {name: median(turn[name] for turn in some) for name in some[0]}
        for count, some in turns.items()
    }


def in_ms(seconds: Seconds) -> dict[str, float | None]:
    """Milliseconds as JSON has them."""
    return {name: number(1000 * value, 4) for name, value in seconds.items()}


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
    return numbers(found, 3)


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
            job = [
                "qsgm.train.grasp.torch_job",
                str(frame),
                str(folder),
                layers,
                epochs,
                seed,
                threads,
            ]
        else:
            job = ["qsgm.cli", "finetune", "--json", "-o", f"{home}/object", *VARIANTS[name]]
            job += ["--layers", layers, "--epochs", epochs, "--seed", seed, "--threads", threads]
            job += ["--trunk", settings.trunk or bundle.manifest.trunk, "--bundle", str(folder)]
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
    """Seconds per stage and variant, the ratios below them, and single steps by threads."""
    jobs = table(
        f"seconds, median of {report['repeats']}: last {report['layers']} layers, "
        f"{report['steps']} steps, threads: {report['threads']}",
        ["", *((stage, "{:.2f}") for stage in STAGES), ("ms a step", "{:.3f}")],
        [
            [name, *stages.values(), report["step_ms"][name]]
            for name, stages in report["seconds"].items()
        ],
    )
    rows = [[name.replace("_", " "), value] for name, value in report["ratios"].items()]
    quotients = table("ratios", ["", ("", "{:.2f}")], rows)
    quotients.show_header = False
    columns: list[str | tuple[str, str]] = [""]
    for count in report["step_table_ms"]:
        columns += [(f"threads: {count}", "{:.3f}"), ("/", "{:.2f}")]
    tables = report["step_table_ms"], report["step_over_qsgm_step"]
    rows = [
        [name, *(some[count][key] for count in tables[0] for some in tables)]
        for key, name in STEPS.items()
    ]
    title = f"a training step, batch {BATCH}: ms, and over the {STEPS[OWN_STEP]} step"
    return Group(jobs, quotients, table(title, columns, rows))
