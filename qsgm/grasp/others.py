"""Things that the user names: `finetune --not` puts them onto crops beside the drawn ones."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.files import sha256
from qsgm.grasp.distractors import TILE_PX, Distractors, with_named
from qsgm.grasp.measuring import measured_span, moved_point, scaled_frame
from qsgm.grasp.patch import PATCH_PX, Patch, cut_patch
from qsgm.grasp.source import Demonstration

# A thing that is larger than that leaves its tile when it is turned.
_LEAST_THING_PX, _LARGEST_THING_PX = 24.0, 120.0
_EDGE_SIGMA_PX = 0.8


@dataclass(frozen=True)
class Other:
    """A thing to tell the object apart from, as it was seen."""

    patch: Patch
    scale: float = 1.0  # what its frame was scaled by for this patch

    @property
    def sha256(self) -> str:
        """Digest of its pixels and its mask."""
        pixels = np.dstack([self.patch.image, self.patch.mask])
        return sha256(pixels.tobytes())


def other_in(demonstration: Demonstration) -> Other:
    """The thing in a frame, cut out at a scale at which it fits a patch."""
    frame, center = demonstration.frame, demonstration.center_px
    span = measured_span(frame, center)
    scale = 1.0 if span is None or span <= _LARGEST_THING_PX else _LARGEST_THING_PX / span
    small = scaled_frame(frame, scale)
    middle = moved_point(center, frame.shape[:2], small.shape[:2])
    return Other(cut_patch(small, middle), scale)


def add_others(
    things: Distractors | None, others: Sequence[Other], scale: float
) -> Distractors | None:
    """Drawn things and named ones, the latter as large as frames show them at a scale."""
    if not others:
        return things
    return with_named(things, np.stack([_sprite(other, scale) for other in others]))


def _sprite(other: Other, scale: float) -> NDArray[np.uint8]:
    """A tile (128, 128, 4), BGR times opacity and opacity."""
    long_px, _ = other.patch.span_px
    # Beyond these it was seen by another camera, or from elsewhere.
    growth = np.clip(scale / other.scale, _LEAST_THING_PX / long_px, _LARGEST_THING_PX / long_px)
    soft = cv2.GaussianBlur(other.patch.mask, (0, 0), _EDGE_SIGMA_PX)[..., None] / np.float32(255)
    layer = np.concatenate([other.patch.image * soft, 255 * soft], axis=2)
    side = 2 * round(PATCH_PX * growth / 2)
    how = cv2.INTER_AREA if growth < 1 else cv2.INTER_LINEAR
    sized = np.rint(cv2.resize(layer, (side, side), interpolation=how)).astype(np.uint8)
    tile = np.zeros((TILE_PX, TILE_PX, 4), np.uint8)
    spare = (TILE_PX - side) // 2
    inner, outer = slice(max(-spare, 0), side + min(spare, 0)), slice(max(spare, 0), None)
    part = sized[inner, inner]
    tile[outer, outer][: len(part), : len(part)] = part
    return tile
