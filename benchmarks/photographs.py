"""Real photographs: taught on an object's first one, looked for in its others and in other things'.

    python benchmarks/photographs.py DIR [--int8] [--any-distance] [--others 12] [--json FILE]

DIR holds photographs and `manifest.json`, a list of objects:

    [{"object": "mug", "photos": [{"file": "mug/0.jpg", "center_px": [310, 220],
      "long_side_px": 140, "turn_deg": 0, "contains": ["mug"]}, ...]}, ...]

The first photograph of each is its demonstration; nothing but its centre is told. A place is right
within 0.27 of the object's long side (24 px of 90) of the true centre. `turn_deg` is since the
demonstration, counter-clockwise, or null; `contains` (optional) names all objects of the list that
are in a photograph, which then is no photograph without them. Photographs of nothing on the list
may be named in `negatives.json`, a list of files.
"""

import argparse
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from qsgm import QsgmError, Settings, load_bundle
from qsgm.bundle import Bundle
from qsgm.grasp.source import Demonstration
from qsgm.grasp.teach import prepare_object, train_object
from qsgm.grasp.tuned import TunedObject
from qsgm.images import read_frame
from qsgm.tune.plan import resolve

RIGHT_SHARE = 0.27
FALSE_ALARMS = (0.005, 0.01, 0.02)


@dataclass(frozen=True)
class Answer:
    """What was found in one photograph."""

    object: str
    file: str
    present: bool
    found: bool
    quality: float
    right: bool
    turn_error_deg: float | None


@dataclass(frozen=True)
class Job:
    """What is measured, and how."""

    folder: Path
    objects: Sequence[Any]  # of the manifest
    bundle: Bundle
    settings: Settings
    any_distance: bool
    others: int  # photographs without each object


def answers_of(job: Job, number: int) -> Iterator[Answer]:
    """Teach one object, look for it where it is and where it is not."""
    one, folder, bundle = job.objects[number], job.folder, job.bundle
    first, *more = one["photos"]
    x, y = map(float, first["center_px"])
    plan = resolve(job.settings, bundle)
    shown = [Demonstration(read_frame(folder / first["file"]), (x, y))]
    taught = train_object(prepare_object(shown, bundle, plan), plan).tuned_object(one["object"])
    for photo in more:
        yield _answer(job, taught, photo)
    for file in _without(job, number):
        yield _answer(job, taught, {"file": file})


def _without(job: Job, number: int) -> list[str]:
    """Photographs in which the object is not: others', then of nothing on the list."""
    objects, count = job.objects, job.others
    name, rng = objects[number]["object"], np.random.default_rng(number)
    free = [
        photo["file"]
        for other in objects
        if other["object"] != name
        for photo in other["photos"]
        if name not in photo.get("contains", ())
    ]
    listed = job.folder / "negatives.json"
    nothing = json.loads(listed.read_text()) if listed.exists() else []
    chosen = [free[i] for i in rng.permutation(len(free))[:count]]
    files = [one["file"] if isinstance(one, dict) else one for one in nothing]
    return chosen + [files[i] for i in rng.permutation(len(files))[: count // 3]]


def _answer(job: Job, taught: TunedObject, photo: dict[str, Any]) -> Answer:
    center, name = photo.get("center_px"), taught.description.name
    try:
        look = taught.locate_at_any_distance if job.any_distance else taught.locate
        found, _ = look(read_frame(job.folder / photo["file"]))
    except QsgmError:  # too small at the object's scale: nothing is found in it
        return Answer(name, photo["file"], center is not None, False, 0.0, False, None)
    right, turn = False, None
    if center is not None:
        right = math.dist(found.center_px, center) <= RIGHT_SHARE * photo["long_side_px"]
        if right and photo.get("turn_deg") is not None:
            turn = abs((found.angle_deg - photo["turn_deg"] + 90) % 180 - 90)
    return Answer(name, photo["file"], center is not None, found.found, found.quality, right, turn)


def table_of(answers: Sequence[Answer], refused: int, objects: int) -> Table:
    """What a reader wants to know of all answers."""
    present = [one for one in answers if one.present]
    absent = [one for one in answers if not one.present]
    turns = [one.turn_error_deg for one in present if one.found and one.turn_error_deg is not None]
    table = Table("", "", title=f"{objects} objects, {refused} of them refused")
    rows = {
        "photographs with the object": len(present),
        "found in the right place": sum(one.found and one.right for one in present),
        "found in a wrong place": sum(one.found and not one.right for one in present),
        "first guess in the right place": sum(one.right for one in present),
        "photographs without it": len(absent),
        "found though absent": sum(one.found for one in absent),
        **{
            f"right at {rate:.1%} found though absent": _right_at(rate, answers)
            for rate in FALSE_ALARMS
        },
        "median turn error": f"{np.median(turns):.1f} deg" if turns else "-",
    }
    for name, value in rows.items():
        table.add_row(name, str(value))
    return table


def _right_at(rate: float, answers: Sequence[Answer]) -> int:
    """How many are right where so many of the photographs without the object are taken for it."""
    threshold = float(np.quantile([one.quality for one in answers if not one.present], 1 - rate))
    return sum(one.present and one.right and one.quality > threshold for one in answers)


def main() -> None:
    """Measure, print, and write what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--bundle", type=Path, default=Path("export"))
    parser.add_argument("--int8", action="store_true")
    parser.add_argument("--any-distance", action="store_true")
    parser.add_argument("--others", type=int, default=12, help="photographs without each object")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    objects = json.loads((asked.folder / "manifest.json").read_text())
    settings = Settings(precision="int8" if asked.int8 else "float")
    bundle = load_bundle(asked.bundle)
    job = Job(asked.folder, objects, bundle, settings, asked.any_distance, asked.others)
    answers, refused = [], []
    for number in track(range(len(objects)), console=Console(stderr=True)):
        name = objects[number]["object"]
        try:
            answers += list(answers_of(job, number))
        except QsgmError as error:
            refused.append({"object": name, "why": str(error)})
    Console().print(table_of(answers, len(refused), len(objects)))
    if asked.json is not None:
        values = {"answers": [asdict(one) for one in answers], "refused": refused}
        asked.json.write_text(json.dumps(values, indent=1))


if __name__ == "__main__":
    main()
