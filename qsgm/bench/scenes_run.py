"""The command `qsgm bench scenes`: subjects in, every method's answers, report and pictures out."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qsgm.bench.composing import Condition
from qsgm.bench.frames import list_frames
from qsgm.bench.rivals import Rival, keep_scenes
from qsgm.bench.scenes import Method, ScenePlan, TunedMethod, measure_scenes
from qsgm.bench.scenes_picture import Album, draw_scenes
from qsgm.bench.scenes_report import report_json
from qsgm.bench.subjects import drawn_subjects, spread, subjects_of
from qsgm.bundle import Bundle
from qsgm.files import write_text_atomic
from qsgm.images import write_png
from qsgm.progress import Progress
from qsgm.tables import to_json
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


def run_scenes(job: SceneJob, watch: Progress) -> dict[str, Any]:
    """The report's JSON; picture, JSON and some of what went wrong are written where asked for.

    Raises:
        QsgmError: the frames, the bundle or a rival cannot be used.
    """
    seed = job.settings.seed
    subjects = drawn_subjects(seed) if job.frames is None else subjects_of(list_frames(job.frames))
    taught = spread(len(subjects), job.limit)
    plan = ScenePlan(tuple(subjects), tuple(taught), job.conditions, job.count, seed)
    if job.keep is not None:
        keep_scenes(plan, job.keep, watch)
    album = Album(tuple(subjects[number].name for number in taught))
    methods: list[Method] = [TunedMethod("qsgm", job.bundle, job.settings), *job.rivals]
    results = measure_scenes(plan, methods, watch, None if job.output is None else album.look)
    source = "drawn" if job.frames is None else str(job.frames)
    values = report_json(plan, job.settings, job.bundle.folder, source, results)
    if job.output is not None:
        write_text_atomic(job.output / "scenes.json", to_json(values) + "\n")
        write_png(job.output / "scenes.png", draw_scenes(values, album))
        for name, picture in album.failures.items():
            write_png(job.output / "failures" / f"{name}.png", picture)
    return values
