"""Teach an object: frames of it in, a tuned object out.

    frame = read_frame(Path("object.png"))
    result = finetune(frame, load_bundle(Path("export")))
    result.save(Path("mug"), name="mug")

The stages stand alone: :func:`prepare_object` does what all methods share, :func:`tune_object` one
run of one method on it.
"""

import time
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qsgm.bundle import Bundle
from qsgm.grasp.lesson import GraspLabels, GraspLesson
from qsgm.grasp.others import Other, add_others
from qsgm.grasp.shown import shown
from qsgm.grasp.source import Demonstration, crop_source
from qsgm.grasp.task import distractors_of, task_of
from qsgm.grasp.taught import FinetuneResult, PreparedObject
from qsgm.images import check_frame
from qsgm.progress import Progress
from qsgm.tune.plan import Plan, resolve
from qsgm.tune.prepare import Prepared, prepare
from qsgm.tune.result import Result
from qsgm.tune.run import Observer, train, tune
from qsgm.tune.settings import Settings

Frame = NDArray[np.uint8]
# One frame with the object at its centre, or some that show it anywhere.
Frames = Frame | Sequence[Frame | Demonstration]


def finetune(
    frames: Frames,
    bundle: Bundle,
    settings: Settings | None = None,
    watch: Progress | None = None,
    others: Sequence[Other] = (),
    span_px: float | None = None,
) -> FinetuneResult:
    """Tune the bundle's network to an object.

    Args:
        frames: a demonstration frame (H, W, 3) BGR with the object at its centre, or several
            frames or :class:`Demonstration` of the same object, of which the first says what
            angle 0 is.
        bundle: whose network is tuned.
        settings: how.
        watch: told about progress.
        others: things to tell the object apart from.
        span_px: the object's long side in the first frame; None: it is measured.

    Raises:
        QsgmError: the object's window leaves the frame, the bundle cannot do what the settings
            ask for, or training diverged.
    """
    plan = resolve(settings or Settings(), bundle)
    return tune_object(prepare_object(frames, bundle, plan, watch, others, span_px), plan, watch)


def prepare_object(
    frames: Frames,
    bundle: Bundle,
    plan: Plan,
    watch: Progress | None = None,
    others: Sequence[Other] = (),
    span_px: float | None = None,
) -> PreparedObject:
    """Crops, features, labels and what the untouched network makes of them.

    Arguments and errors as :func:`finetune` has them.
    """
    began = time.perf_counter()
    demonstrations, task = as_demonstrations(frames), task_of(bundle)
    seen = shown(demonstrations, span_px)
    things = add_others(distractors_of(bundle), others, seen.scale)
    rng = np.random.default_rng(plan.settings.seed)
    crops = crop_source(seen.demonstrations, things, rng)
    prepared = prepare(GraspLesson(crops, task.encoding, seen.turns_rad), bundle, plan, watch)
    assert isinstance(prepared.labelled, GraspLabels)
    seconds = prepared.seconds | {"total": time.perf_counter() - began}
    sums = tuple(other.sha256 for other in others)
    values = _values(prepared) | {"seconds": seconds}
    return PreparedObject(**values, shown=seen, others_sha256=sums)


def tune_object(
    prepared: PreparedObject, plan: Plan, watch: Progress | None = None
) -> FinetuneResult:
    """One run with probes and warnings; see :func:`qsgm.tune.run.tune`."""
    return FinetuneResult(**_values(tune(prepared, plan, watch)))


def train_object(
    prepared: PreparedObject, plan: Plan, observers: Sequence[Observer] = ()
) -> FinetuneResult:
    """The training alone; see :func:`qsgm.tune.run.train`."""
    return FinetuneResult(**_values(train(prepared, plan, observers)))


def as_demonstrations(frames: Frames) -> list[Demonstration]:
    """Frames, each with where its object is: at its middle where it does not say."""
    some = list(frames) if isinstance(frames, Sequence) else [frames]
    if not some:
        raise ValueError("`frames` must hold at least one frame")
    found = []
    for one in some:
        frame = check_frame(one.frame if isinstance(one, Demonstration) else one)
        center = (frame.shape[1] / 2, frame.shape[0] / 2)
        found.append(one if isinstance(one, Demonstration) else Demonstration(frame, center))
    return found


def _values(result: Prepared | Result) -> dict[str, Any]:
    """Every field, to make more of it."""
    return {one.name: getattr(result, one.name) for one in fields(result)}
