"""Objects looked for in camera images, and taught from them, without ROS.

Messages come and go as whatever has their fields: the node gives the types of ROS, tests their own.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qsgm import Bundle, Detection, QsgmError, Settings, TunedObject, finetune, load_bundle, paths
from qsgm.grasp.network import CROP_PX
from qsgm.grasp.pictures import draw_objects
from qsgm.grasp.sights import look_for, named_places
from qsgm.images import check_demonstration
from qsgm.store import load_objects
from qsgm_ros.images import Frame, fill_image, frame_of


@dataclass(frozen=True)
class Messages:
    """Makers of empty messages."""

    image: Callable[[], Any]  # sensor_msgs/Image
    detections: Callable[[], Any]  # vision_msgs/Detection2DArray
    detection: Callable[[], Any]  # vision_msgs/Detection2D
    hypothesis: Callable[[], Any]  # vision_msgs/ObjectHypothesisWithPose


@dataclass(frozen=True)
class Options:
    """The node's parameters."""

    bundle: str = ""  # folder; empty: the one that ships
    objects: Sequence[str] = ()  # names or folders of objects taught before
    teach_as: str = "object"  # what the next object is called
    int8: bool = True
    epochs: int = 10
    threads: int = 1
    every_instance: bool = False
    any_distance: bool = False

    @property
    def settings(self) -> Settings:
        """How an object is taught."""
        precision = "int8" if self.int8 else "float"
        return Settings(precision=precision, epochs=self.epochs, threads=self.threads)


class Finder:
    """The objects known so far, and the last image seen."""

    def __init__(self, options: Options, messages: Messages) -> None:
        """Load the bundle and the objects. Raises QsgmError where one cannot be used."""
        self.options, self._messages = options, messages
        self._bundle = open_bundle(options.bundle)
        given = [Path(one) for one in options.objects if one]
        loaded = load_objects(given, options.threads) if given else []
        self._objects: dict[str, TunedObject] = {one.description.name: one for one in loaded}
        self._last: Frame | None = None

    @property
    def names(self) -> list[str]:
        """What it looks for."""
        return [*self._objects]

    def see(self, image: Any) -> tuple[Any, Any]:
        """What is found in an image, as detections, and a picture of it.

        Raises:
            QsgmError: the image cannot be read, or is too small for an object.
        """
        self._last = frame = frame_of(image)
        options = self.options
        sights = [
            look_for(
                one, frame, everything=options.every_instance, any_distance=options.any_distance
            )
            for one in self._objects.values()
        ]
        places = named_places(sights)
        found = self._messages.detections()
        found.header = image.header
        found.detections = [
            self._detection(name, place, image.header) for name, place in places if place.found
        ]
        picture = draw_objects(frame, places, enlarged=False)
        return found, fill_image(self._messages.image(), picture, image.header)

    def teach(self, name: str) -> tuple[bool, str]:
        """Tune the network to what the last image shows at its centre.

        Returns:
            Whether it was taught, and what to expect of it, or what went wrong.
        """
        try:
            if self._last is None:
                raise QsgmError("no image has come yet: expected one; check the camera's topic")
            if not name.strip():
                raise QsgmError("the object has no name: expected one; set `teach_as`")
            check_demonstration(self._last, Path("the last image"))
            folder = paths.folder_named(name)
            result = finetune(self._last, self._bundle, self.options.settings)
            result.save(folder, name)
        except QsgmError as error:
            return False, str(error)
        self._objects[name] = result.tuned_object(name)
        verdict = result.verdict
        return True, "; ".join([f"{name} {verdict.headline}", *verdict.reasons])

    def _detection(self, name: str, place: Detection, header: Any) -> Any:
        """One place of an object; its box is the window that the network sees."""
        one, hypothesis = self._messages.detection(), self._messages.hypothesis()
        one.header, one.id = header, name
        hypothesis.hypothesis.class_id, hypothesis.hypothesis.score = name, float(place.quality)
        one.results = [hypothesis]
        center, turn = one.bbox.center, place.full_angle_deg
        center.position.x, center.position.y = (float(value) for value in place.center_px)
        # Counter-clockwise as it is seen is from y to x where y points down.
        center.theta = -math.radians(place.angle_deg if turn is None else turn)
        one.bbox.size_x = one.bbox.size_y = CROP_PX / place.scale
        return one


def open_bundle(folder: str) -> Bundle:
    """A bundle by its folder, or the one that ships. Raises QsgmError where it cannot be used."""
    return load_bundle(paths.bundle_folder(Path(folder) if folder else None))
