"""A tuned object: a folder with a stand-alone ONNX network, how to read it, and the report.

Beside the network lie the demonstration's patch, by which places that the network proposes are
judged, and all that tells how the object was made. Folders of version 1 have no patch: they are
read as ever, and the network alone says where the object is.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.errors import QsgmError, as_text
from qsgm.files import read_whole, sha256
from qsgm.grasp.angles import ENCODINGS, AngleEncoding
from qsgm.grasp.candidates import candidate_cells
from qsgm.grasp.decision import FALSE_ALARM_RATE, Decision
from qsgm.grasp.finding import MOST_INSTANCES, Finder, Sighting
from qsgm.grasp.heatmap import CELL_PX, Detection, locate, refine
from qsgm.grasp.judge import QUICK, THOROUGH, Effort, cell_center
from qsgm.grasp.measuring import MOST_ENLARGED, moved_point, scaled_frame, scaled_shape
from qsgm.grasp.network import CROP_PX
from qsgm.grasp.others import Other
from qsgm.grasp.patch import PATCH_PX, Patch, decode_patch, encode_patch
from qsgm.grasp.shown import View
from qsgm.images import MAX_SIDE_PX, check_frame
from qsgm.manifest import NETWORK
from qsgm.runtime import Value, check_interface, open_session, run_options, running
from qsgm.tuned_folder import (
    COMMAND,
    DESCRIPTION,
    VERSION,
    read_description,
    require_keys,
    unaltered,
    write_tuned,
)

VERSIONS = (1, VERSION)
PATCH = "patch.png"
MOST_BYTES = 16_000_000  # of the network, of a patch
MOST_VIEWS = 100
FOUND_FROM = 0.5
# Without a decision the patch moves a detection only where it fits as well as that.
STRONG_CORRELATION = 0.7
# A frame is mirrored so far beyond its border (at the object's scale) that windows can be centred
# on objects that lie close to it.
MARGIN_PX = 48
_LEAST_SIDE_PX = 64
# Where that is asked for, an object that is not found is looked for more closely, and as if it were
# so many times as large. More looks are more occasions to be wrong: a place has to be surer there.
OTHER_SIZES = (0.5, 0.7, 1.4, 2.0)
SURE_MORE_CLOSELY, SURE_AT_OTHER_SIZES = 0.6, 0.85
# The network sees larger frames strip by strip: 60 MB are enough then, whatever their size. Up to
# half as large ones (a camera's 640x480) leave ONNX Runtime's memory to the next frame.
_STRIP_PIXELS = 1 << 20
_KEPT_PIXELS = _STRIP_PIXELS // 2
# At the object's scale, larger frames than that are not looked at again.
_LARGEST_SIDE_PX = 2048
# Two places of the network that are closer are of the same object.
_APART_PX = 48.0
_TAKES: dict[str, Value] = {"frame": ("tensor(uint8)", (None, None, 3))}
_GIVES: dict[str, Value] = {"heatmap": ("tensor(float)", (3, None, None))}
_ADVICE = "tune the object again with `qsgm finetune`"
_KEYS: dict[str, type] = {"name": str, "encoding": str, "offset_rad": float, "sha256": str}
_NEW_KEYS: dict[str, type] = {"scale": float, "views": list, "made": dict}


@dataclass(frozen=True)
class ObjectDescription:
    """What `predict` has to know beside the network."""

    name: str
    encoding: AngleEncoding
    offset_rad: float  # orientation of the demonstration as the network sees it
    scale: float = 1.0  # what frames are scaled by before the network sees them
    views: tuple[View, ...] = ()  # none in an object of version 1
    decision: Decision | None = None
    made: Mapping[str, Any] = field(default_factory=dict)  # from what, by what


class TunedObject:
    """A tuned object, ready to be looked for."""

    def __init__(self, description: ObjectDescription, network: bytes, threads: int) -> None:
        self.description = description
        self._remade_from = description, network, threads
        name = f"the network of {description.name!r}"
        self._session = open_session(network, threads, name=name)
        check_interface(self._session, name, _TAKES, _GIVES, _ADVICE)

    def __reduce__(self) -> tuple[type, tuple[ObjectDescription, bytes, int]]:
        """Pickled without its session, which is opened anew."""
        return type(self), self._remade_from

    def heatmap(self, frame: NDArray[np.uint8]) -> NDArray[np.float32]:
        """A frame (H, W, 3) at the object's scale to quality, sine and cosine (3, rows, cols)."""
        frame = check_frame(frame, MARGIN_PX)
        large = frame.shape[0] * frame.shape[1] > _KEPT_PIXELS
        strips = [
            self._answer(strip, give_memory_back=large and rows is None)[:, :rows]
            for strip, rows in _strips(frame)
        ]
        return np.concatenate(strips, axis=1)

    def _answer(self, frame: NDArray[np.uint8], *, give_memory_back: bool) -> NDArray[np.float32]:
        name = self.description.name
        options = run_options(give_memory_back=give_memory_back)
        with running(f"the object {name!r}", _ADVICE):
            heatmap: NDArray[np.float32]
            (heatmap,) = self._session.run(["heatmap"], {"frame": frame}, options)
        if not _is_of(heatmap, frame):
            raise QsgmError(
                f"the object {name!r} answers {heatmap.shape} numbers, expected 3 for every window "
                f"in a frame of {frame.shape[1]}x{frame.shape[0]} px; {_ADVICE}"
            )
        low, high = float(heatmap[0].min()), float(heatmap[0].max())
        if not (0 <= low <= high <= 1 and np.isfinite(heatmap).all()):
            raise QsgmError(
                f"the object {name!r} answers with qualities of {low:.3g} to {high:.3g}, NaN or "
                f"infinity, expected finite numbers, qualities of 0 to 1; {_ADVICE}"
            )
        return heatmap

    def locate(self, frame: NDArray[np.uint8]) -> tuple[Detection, NDArray[np.float32]]:
        """Where the object is in a frame (H, W, 3), and the heatmap that says so.

        The network proposes places, what the object looked like decides between them and says where
        exactly and how far turned it is. Everything is in the frame's own pixels.
        """
        seen = self._seen(frame)
        heatmap = self.heatmap(seen)
        return self._best(frame, seen, heatmap, QUICK), heatmap

    def locate_at_any_distance(
        self, frame: NDArray[np.uint8]
    ) -> tuple[Detection, NDArray[np.float32]]:
        """As :meth:`locate`; where nothing is found, more closely, and from other distances.

        That is half to twice the demonstration's.
        """
        first, heatmap = self.locate(frame)
        if first.found:
            return first, heatmap
        looks = [(self._more_closely(frame, heatmap), heatmap)]
        for other in self._at_other_sizes(frame):
            there, its_heatmap = other.locate(frame)
            looks.append((_surely(there, SURE_AT_OTHER_SIZES), its_heatmap))
        found = [look for look in looks if look[0].found]
        return max(found, key=lambda look: look[0].quality, default=(first, heatmap))

    def _more_closely(self, frame: NDArray[np.uint8], heatmap: NDArray[np.float32]) -> Detection:
        """The best place by a thorough look.

        What the network saw of the frame is made anew: kept, it would be 37 MB of a large one.
        """
        closely = self._best(frame, self._seen(frame), heatmap, THOROUGH)
        return _surely(closely, SURE_MORE_CLOSELY)

    def _at_other_sizes(self, frame: NDArray[np.uint8]) -> Iterator["TunedObject"]:
        """The same object as if it were larger or smaller, where the frame can be searched so."""
        for size in OTHER_SIZES:
            scale = self.description.scale / size
            sides = scaled_shape(frame.shape[:2], scale)
            if min(sides) >= self._least_side_px and max(sides) <= _LARGEST_SIDE_PX:
                other = object.__new__(type(self))  # not a copy: it shares the session
                vars(other).update(vars(self))
                other.description = replace(self.description, scale=scale)
                yield other

    def locate_all(self, frame: NDArray[np.uint8]) -> list[Detection]:
        """Every instance of the object in a frame (H, W, 3), the surest first."""
        seen = self._seen(frame)
        found = self._detections(seen, self.heatmap(seen), Effort.for_places(MOST_INSTANCES))
        refined = [self._refined(one, seen) for one in found if one.found]
        return [self._in_frame(one, frame) for one in refined]

    def as_other(self) -> Other:
        """What it looks like, for another object to be told apart from it.

        Raises:
            QsgmError: the object is of version 1, which does not know.
        """
        about = self.description
        if not about.views:
            raise QsgmError(
                f"{about.name!r} was tuned by a version of qsgm that kept no picture of it; "
                f"{_ADVICE}, or pass a frame of it"
            )
        return Other(about.views[0].patch, about.scale)

    @cached_property
    def _finder(self) -> Finder | None:
        """None in an object without a patch."""
        about = self.description
        if not about.views:
            return None
        return Finder(about.views)

    @property
    def _margin_px(self) -> int:
        """Objects of version 1 see frames as they are."""
        return MARGIN_PX if self.description.views else 0

    @property
    def _least_side_px(self) -> int:
        """What has to be left of a frame at the object's scale."""
        return _LEAST_SIDE_PX if self._margin_px else CROP_PX

    def _seen(self, frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The frame at the object's scale, mirrored beyond its border.

        Raises:
            QsgmError: too little is left of it, or it is too much.
        """
        frame = check_frame(frame)
        scale, margin, least = self.description.scale, self._margin_px, self._least_side_px
        sides = scaled_shape(frame.shape[:2], scale)
        if not least <= min(sides) <= max(sides) <= MAX_SIDE_PX:
            (height, width), (low, narrow) = frame.shape[:2], sides
            raise QsgmError(
                f"a frame of {width}x{height} px has {narrow}x{low} at the scale of "
                f"{self.description.name!r}: expected {least} to {MAX_SIDE_PX} on each side; take "
                "it as the object's demonstration was taken"
            )
        scaled = scaled_frame(frame, scale)
        how = cv2.BORDER_REFLECT_101
        seen = cv2.copyMakeBorder(scaled, margin, margin, margin, margin, how)
        return np.asarray(seen, dtype=np.uint8)

    def _best(
        self,
        frame: NDArray[np.uint8],
        seen: NDArray[np.uint8],
        heatmap: NDArray[np.float32],
        effort: Effort,
    ) -> Detection:
        """The best place, and all candidates, in the frame's own pixels."""
        found = self._detections(seen, heatmap, effort)
        places = tuple(self._in_frame(self._refined(one, seen), frame) for one in found)
        return replace(places[0], candidates=places)

    def _detections(
        self, seen: NDArray[np.uint8], heatmap: NDArray[np.float32], effort: Effort
    ) -> list[Detection]:
        """The best places first, at least one, none of them refined by the network yet."""
        coarse = self._at(heatmap, seen)
        decision = self.description.decision
        if self._finder is None or decision is None:
            return [coarse, *self._further(coarse, seen, heatmap, effort.judged)]
        sightings = self._finder.find(seen, heatmap, decision, effort)
        return [_as_detection(one) for one in sightings]

    def _further(
        self,
        coarse: Detection,
        seen: NDArray[np.uint8],
        heatmap: NDArray[np.float32],
        count: int,
    ) -> list[Detection]:
        """What else the network sees, apart from its best place."""
        places = [coarse]
        for cell in candidate_cells(heatmap[0], count):
            center = cell_center(cell)
            if all(math.dist(center, place.center_px) >= _APART_PX for place in places):
                places.append(self._at(_around(heatmap, cell), seen))
        return places[1:]

    def _at(self, heatmap: NDArray[np.float32], seen: NDArray[np.uint8]) -> Detection:
        height, width = seen.shape[:2]
        about = self.description
        return locate(heatmap, (height, width), about.offset_rad, about.encoding, FOUND_FROM)

    def _refined(self, place: Detection, seen: NDArray[np.uint8]) -> Detection:
        """A closer look by the network where the patch had none, or none worth the name."""
        if not place.found or place.refined_by == "patch":
            return place
        about = self.description
        closer = refine(place, seen, self.heatmap, about.offset_rad, about.encoding)
        if self._finder is None or about.decision is not None:
            return closer
        laid = self._finder.lay(seen, closer.center_px)
        return _moved(closer, laid) if laid.fit.score >= STRONG_CORRELATION else closer

    def _in_frame(self, place: Detection, frame: NDArray[np.uint8]) -> Detection:
        """A place of what the network saw in the frame's own pixels."""
        height, width = frame.shape[:2]
        center = self._point_in(frame, place.center_px)
        return replace(
            place,
            center_px=center,
            displacement_px=(center[0] - width / 2, center[1] - height / 2),
            scale=self.description.scale,
            margin_px=self._margin_px,
        )

    def _point_in(
        self, frame: NDArray[np.uint8], point_px: tuple[float, float]
    ) -> tuple[float, float]:
        x, y = (value - self._margin_px for value in point_px)
        scale = self.description.scale
        if scale == 1.0:
            return x, y
        scaled_hw = scaled_shape(frame.shape[:2], scale)
        return moved_point((x, y), scaled_hw, frame.shape[:2])


def save_object(
    folder: Path, description: ObjectDescription, network: bytes, report: dict[str, Any]
) -> None:
    """Write a tuned object; the folder appears complete or not at all.

    Raises:
        QsgmError: the folder cannot be written, or holds something else.
    """
    patches = {
        PATCH if number == 1 else f"patch_{number}.png": encode_patch(view.patch)
        for number, view in enumerate(description.views, start=1)
    }
    write_tuned(folder, network, _to_json(description, patches), report, patches)


def load_object(folder: Path, threads: int = 1) -> TunedObject:
    """Read a tuned object back.

    Raises:
        QsgmError: it is missing, altered, or something else.
    """
    return TunedObject(*read_object(folder), threads)


def read_object(folder: Path) -> tuple[ObjectDescription, bytes]:
    """What an object's folder says, and its network as an ONNX file; nothing is run.

    Raises:
        QsgmError: it is missing, altered, or something else.
    """
    return read_whole(folder, lambda: _read_object(folder))


def _read_object(folder: Path) -> tuple[ObjectDescription, bytes]:
    path = folder / DESCRIPTION
    manifest = read_description(folder, VERSIONS, f"an object written by `{COMMAND}`")
    if "task" in manifest:
        raise QsgmError(
            f"{folder} is a tuned network of another task, no object to look for in a frame; pass "
            "`qsgm predict` its samples instead"
        )
    first = manifest["version"] == VERSIONS[0]
    require_keys(path, manifest, _KEYS | ({} if first else _NEW_KEYS))
    name, encoding, offset_rad = (manifest[key] for key in ("name", "encoding", "offset_rad"))
    if encoding not in ENCODINGS or not math.isfinite(offset_rad):
        raise QsgmError(
            f"{path}: expected encoding {' or '.join(ENCODINGS)} and a finite "
            f"offset_rad, got {encoding!r} and {offset_rad}; {_ADVICE}"
        )
    network = unaltered(folder, NETWORK, manifest["sha256"], MOST_BYTES, _ADVICE)
    description = ObjectDescription(as_text(name), encoding, float(offset_rad))
    if not first:
        description = _with_looks(description, folder, manifest)
    return description, network


def _to_json(about: ObjectDescription, patches: Mapping[str, bytes]) -> dict[str, Any]:
    decision = about.decision
    return {
        "name": about.name,
        "encoding": about.encoding,
        "offset_rad": about.offset_rad,
        "scale": about.scale,
        "views": [
            {
                "file": name,
                "sha256": sha256(data),
                "center_px": list(view.patch.center_px),
                "cut_out": view.patch.cut_out,
                "turn_rad": view.turn_rad,
                "whole": view.whole,
            }
            for view, (name, data) in zip(about.views, patches.items(), strict=True)
        ],
        "decision": None if decision is None else decision.to_json(),
        "threshold": {
            "quality": FOUND_FROM,
            "false_alarm_rate": None if decision is None else FALSE_ALARM_RATE,
        },
        "made": dict(about.made),
    }


def _with_looks(
    description: ObjectDescription, folder: Path, manifest: Mapping[str, Any]
) -> ObjectDescription:
    """What an object of version 2 says beyond one of version 1.

    Raises:
        QsgmError: a patch is missing or altered, or the description says nonsense.
    """
    path = folder / DESCRIPTION
    decision = manifest.get("decision")
    try:
        views = tuple(_view(folder, one) for one in manifest["views"][: MOST_VIEWS + 1])
        scale = float(manifest["scale"])
        sane = (
            len(views) <= MOST_VIEWS
            and 0 < scale <= MOST_ENLARGED
            and all(math.isfinite(one.turn_rad) for one in views)
        )
    except (KeyError, TypeError, ValueError, AttributeError):
        sane = False
    if not sane:
        raise QsgmError(f"{path}: 'views' or 'scale' is damaged; {_ADVICE}")
    return replace(
        description,
        scale=scale,
        views=views,
        decision=None if decision is None else Decision.from_json(decision, str(path)),
        made=manifest["made"],
    )


def _view(folder: Path, entry: Mapping[str, Any]) -> View:
    data = unaltered(folder, entry["file"], entry["sha256"], MOST_BYTES, _ADVICE)
    x, y = (float(value) for value in entry["center_px"])
    if not (0 <= x <= PATCH_PX and 0 <= y <= PATCH_PX):
        raise ValueError(f"`center_px` must lie in the patch, got {(x, y)}")
    image, mask = decode_patch(data, folder / entry["file"])
    patch = Patch(image, mask, (x, y), bool(entry["cut_out"]))
    return View(patch, float(entry["turn_rad"]), bool(entry["whole"]))


def _strips(frame: NDArray[np.uint8]) -> Iterator[tuple[NDArray[np.uint8], int | None]]:
    """Strips of a frame, and how many rows of windows each is for; of the last, all it has.

    One after the other they give the same heatmap, bit by bit.
    """
    height, width = frame.shape[:2]
    rows = max((_STRIP_PIXELS // width - CROP_PX) // CELL_PX + 1, 1)
    tops = range(0, max(height - CROP_PX, 0) // CELL_PX + 1, rows)
    for top in tops[:-1]:
        first = CELL_PX * top
        yield frame[first : first + CELL_PX * (rows - 1) + CROP_PX], rows
    yield frame[CELL_PX * tops[-1] :], None


def _is_of(heatmap: NDArray[np.float32], frame: NDArray[np.uint8]) -> bool:
    """Whether a heatmap has a frame's windows: those in it, and perhaps those just over its end."""
    if heatmap.ndim != 3 or heatmap.shape[0] != 3:
        return False
    inside = (1 + (side - CROP_PX) // CELL_PX for side in frame.shape[:2])
    return all(n in (few, few + 1) for n, few in zip(heatmap.shape[1:], inside, strict=True))


def _surely(place: Detection, least: float) -> Detection:
    """A place, found only where it is as sure as that."""
    candidates = tuple(replace(one, found=one.quality >= least) for one in place.candidates)
    return replace(place, found=place.quality >= least, candidates=candidates)


def _as_detection(sighting: Sighting) -> Detection:
    """By the patch, or, where that is weak, the place that the network is to look at again."""
    nothing = Detection(
        sighting.quality >= FOUND_FROM,
        sighting.quality,
        sighting.cell_px if sighting.weak else sighting.center_px,
        (0.0, 0.0),
        sighting.angle_deg,
    )
    return nothing if sighting.weak else _moved(nothing, sighting)


def _moved(place: Detection, sighting: Sighting) -> Detection:
    """The same place with centre and turn as the patch lies there."""
    return replace(
        place,
        center_px=sighting.center_px,
        angle_deg=sighting.angle_deg,
        full_angle_deg=sighting.full_angle_deg,
        full_angle_confidence=sighting.confidence,
        refined_by="patch",
    )


def _around(heatmap: NDArray[np.float32], cell: tuple[int, int]) -> NDArray[np.float32]:
    """A heatmap (3, rows, cols) with no quality but around a cell."""
    row, col = cell
    near = slice(max(row - 1, 0), row + 2), slice(max(col - 1, 0), col + 2)
    alone = heatmap.copy()
    alone[0] = 0
    alone[0][near] = heatmap[0][near]
    return alone
