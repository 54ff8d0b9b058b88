"""Short runs on the object of the shared frame, as several tests want them."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from qsgm.bundle import Bundle
from qsgm.grasp.crops import CROPS
from qsgm.grasp.others import Other
from qsgm.grasp.source import CropSource, Demonstration, crop_source
from qsgm.grasp.task import distractors_of
from qsgm.grasp.taught import FinetuneResult, PreparedObject
from qsgm.grasp.teach import prepare_object, tune_object
from qsgm.tune.plan import resolve
from qsgm.tune.settings import Settings

Frame = NDArray[np.uint8]
SHORT = Settings(precision="int8", epochs=2)


def prepared_by(
    settings: Settings, frame: Frame | Demonstration, bundle: Bundle, others: Sequence[Other] = ()
) -> PreparedObject:
    """What a run with these settings starts from."""
    frames = frame if isinstance(frame, np.ndarray) else [frame]
    return prepare_object(frames, bundle, resolve(settings, bundle), others=others)


def tuned_by(settings: Settings, prepared: PreparedObject) -> FinetuneResult:
    """One run on what was prepared."""
    return tune_object(prepared, resolve(settings, prepared.bundle))


def planned(
    frame: Frame,
    bundle: Bundle,
    center_px: tuple[float, float] = (320.0, 240.0),
    count: int = CROPS,
) -> CropSource:
    """The crops of a run with seed 0."""
    shown = Demonstration(frame, center_px)
    return crop_source([shown], distractors_of(bundle), np.random.default_rng(0), count)
