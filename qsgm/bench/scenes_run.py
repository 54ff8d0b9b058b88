"""The command `qsgm bench scenes`: subjects in, every method's answers, report and pictures out."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from qsgm.bench.composing import CONDITIONS
from qsgm.bench.frames import list_frames, spread
from qsgm.bench.rivals import Rival, keep_scenes
from qsgm.bench.scenes import Method, ScenePlan, TunedMethod, measure_scenes
from qsgm.bench.scenes_picture import Album, draw_scenes
from qsgm.bench.scenes_report import report_json
from qsgm.bench.subjects import drawn_subjects, subjects_of
from qsgm.bundle import Bundle
from qsgm.files import write_text_atomic
from qsgm.images import write_png
from qsgm.progress import Progress
from qsgm.tables import to_json
from qsgm.tune.settings import Settings


def run_scenes(
    *,
    frames: Path | None,
    limit: int | None,
    conditions: Sequence[str],
    count: int,
    settings: Settings,
    bundle: Bundle,
    rivals: Sequence[Rival],
    keep: Path | None,
    output: Path | None,
    watch: Progress,
) -> dict[str, Any]:
    """The report's JSON; picture, JSON and some of what went wrong are written where asked for.

    Args:
        frames: a folder of demonstrations with masks; None: drawn subjects.
        limit: of the subjects that are looked for.
        count: of pairs, for each subject and condition.
        keep: folder for all scenes and the truth.
        output: folder for report and pictures.

    Raises:
        QsgmError: the frames, the bundle or a rival cannot be used.
    """
    subjects = drawn_subjects(settings.seed) if frames is None else subjects_of(list_frames(frames))
    taught = spread(len(subjects), limit)
    asked = tuple(name for name in CONDITIONS if name in conditions)
    plan = ScenePlan(tuple(subjects), tuple(taught), asked, count, settings.seed)
    if keep is not None:
        keep_scenes(plan, keep, watch)
    album = Album(tuple(subjects[number].name for number in taught))
    methods: list[Method] = [TunedMethod("qsgm", bundle, settings), *rivals]
    results = measure_scenes(plan, methods, watch, None if output is None else album.look)
    source = "drawn" if frames is None else str(frames)
    values = report_json(plan, settings, bundle.folder, source, results)
    if output is not None:
        write_text_atomic(output / "scenes.json", to_json(values) + "\n")
        write_png(output / "scenes.png", draw_scenes(values, album))
        for name, picture in album.failures.items():
            write_png(output / "failures" / f"{name}.png", picture)
    return values
