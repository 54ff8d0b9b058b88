"""The command `qsgm bench scenes`: subjects in, every method's answers, report and pictures out."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import RenderableType

from qsgm.bench.composing import Condition, Subject
from qsgm.bench.frames import list_frames
from qsgm.bench.rivals import Rival, keep_scenes
from qsgm.bench.scenes import ScenePlan, TunedMethod, measure_scenes
from qsgm.bench.scenes_picture import Album, draw_scenes
from qsgm.bench.scenes_report import ScenesReport
from qsgm.bench.subjects import drawn_subjects, spread, subjects_of
from qsgm.bundle import Bundle
from qsgm.files import write_text_atomic
from qsgm.images import write_png
from qsgm.tune.prepare import Watch
from qsgm.tune.report import to_json
from qsgm.tune.settings import Settings


@dataclass(frozen=True)
class SceneJob:
    """What the command was asked for."""

    frames: Path | None  # None: drawn subjects
    limit: int | None
    conditions: tuple[Condition, ...]
    count: int
    settings: Settings
    bundle: Bundle
    rivals: tuple[Rival, ...] = ()
    keep: Path | None = None
    output: Path | None = None


def run_scenes(job: SceneJob, watch: Watch) -> tuple[dict[str, Any], RenderableType]:
    """The report's JSON and its tables.

    Raises:
        QsgmError: the frames, the bundle or a rival cannot be used.
    """
    subjects = _subjects(job)
    taught = spread(len(subjects), job.limit)
    plan = ScenePlan(tuple(subjects), tuple(taught), job.conditions, job.count, job.settings.seed)
    if job.keep is not None:
        keep_scenes(plan, job.keep, watch)
    album = Album(tuple(subjects[number].name for number in taught))
    measured = TunedMethod("qsgm", job.bundle, job.settings)
    look = None if job.output is None else album.look
    results = measure_scenes(plan, [measured, *job.rivals], watch, look)
    source = "drawn" if job.frames is None else str(job.frames)
    report = ScenesReport(plan, job.settings, job.bundle.folder, source, tuple(results))
    values = report.to_json()
    if job.output is not None:
        _write(job.output, values, album)
    return values, report.render(values)


def _subjects(job: SceneJob) -> list[Subject]:
    if job.frames is None:
        return drawn_subjects(job.settings.seed)
    return subjects_of(list_frames(job.frames))


def _write(folder: Path, values: dict[str, Any], album: Album) -> None:
    """Picture, JSON, and some of what went wrong."""
    write_text_atomic(folder / "scenes.json", to_json(values) + "\n")
    write_png(folder / "scenes.png", draw_scenes(values, album))
    for name, picture in album.failures.items():
        write_png(folder / "failures" / f"{name}.png", picture)
