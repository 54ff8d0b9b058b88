"""Teach on one frame, find the object in scenes made from it; and do not find it where it is not.

The true centre of a scene is where the demonstration's centre pixel came to lie.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import RenderableType

from qsgm.angles import angle_error
from qsgm.bench.frames import BenchFrame
from qsgm.bench.staging import Scene, cut_out, make_scenes
from qsgm.bundle import Bundle
from qsgm.finetuning import train
from qsgm.images import write_png
from qsgm.pictures import draw_detection
from qsgm.predict import Detection
from qsgm.preparing import Watch, prepare
from qsgm.report import number, plain_table
from qsgm.settings import Settings

# A detection this close to the true centre is one of the object.
ON_OBJECT_PX = 24.0
# Pictures of so many frames, evenly spread, show what is going on; false detections always do.
PICTURES_OF_FRAMES = 6


@dataclass(frozen=True)
class SceneResult:
    """What was found in one scene, and what is there."""

    frame: BenchFrame
    scene: Scene
    detection: Detection

    @property
    def present(self) -> bool:
        return self.scene.center_px is not None

    @property
    def center_error_px(self) -> float:
        """Distance of the best guess from the true centre; infinite where there is no object."""
        if self.scene.center_px is None:
            return math.inf
        return math.dist(self.detection.center_px, self.scene.center_px)

    @property
    def turn_error_deg(self) -> float:
        """Modulo 180 degrees."""
        found = np.array([math.radians(self.detection.angle_deg)])
        return math.degrees(float(angle_error(found, np.array([self.scene.turn_rad]))[0]))

    @property
    def on_object(self) -> bool:
        return self.detection.found and self.center_error_px <= ON_OBJECT_PX

    @property
    def false_detection(self) -> bool:
        """Something else was taken for the object, whether it is in the scene or not."""
        return self.detection.found and not self.on_object


@dataclass(frozen=True)
class ScenesReport:
    """All scenes of all frames."""

    settings: Settings
    bundle: Bundle
    results: tuple[SceneResult, ...]

    def summary(self) -> dict[str, float | int | None]:
        """The figures that count. Turns are those of elongated objects, where a manifest says."""
        present = [result for result in self.results if result.present]
        empty = [result for result in self.results if not result.present]
        hits = [result for result in present if result.on_object]
        turns = [hit.turn_error_deg for hit in hits if hit.frame.elongated is not False]
        return {
            "scenes": len(present),
            "empty_scenes": len(empty),
            "median_center_error_px": _median([result.center_error_px for result in present]),
            "median_turn_error_deg": _median(turns),
            "found_share": _share([result.on_object for result in present]),
            "missed": sum(not result.detection.found for result in present),
            "false_detections": sum(result.false_detection for result in self.results),
            "false_detections_elsewhere": sum(result.false_detection for result in present),
            "false_detections_empty": sum(result.false_detection for result in empty),
            "free_of_false_detections": _share([not r.false_detection for r in self.results]),
        }

    def to_json(self) -> dict[str, Any]:
        return {
            "bundle": str(self.bundle.folder),
            "method": self.settings.method,
            "precision": self.settings.precision,
            "layers": self.settings.layers,
            "epochs": self.settings.epochs,
            "seed": self.settings.seed,
            **self.summary(),
            "per_scene": [_scene_json(result) for result in self.results],
        }

    def render(self) -> RenderableType:
        """The summary, line by line."""
        values = self.summary()
        table = plain_table("objects looked for in scenes")
        table.show_header = False
        table.add_column()
        table.add_column(justify="right")
        scenes, empty = values["scenes"], values["empty_scenes"]
        table.add_row("scenes with the object, without it", f"{scenes}, {empty}")
        table.add_row(f"found within {ON_OBJECT_PX:.0f} px", _percent(values["found_share"]))
        table.add_row("not found", str(values["missed"]))
        table.add_row("median centre error", _with_unit(values["median_center_error_px"], " px"))
        table.add_row("median turn error, elongated objects", f"{values['median_turn_error_deg']}°")
        table.add_row("detected elsewhere", str(values["false_detections_elsewhere"]))
        table.add_row("detected on the empty table", str(values["false_detections_empty"]))
        return table


def measure_scenes(
    frames: Sequence[BenchFrame],
    bundle: Bundle,
    settings: Settings,
    count: int,
    watch: Watch,
    pictures: Path | None = None,
) -> ScenesReport:
    """Teach on every frame and look for it in `count` scenes with it and one without it.

    Args:
        frames: each with a mask.
        bundle: to tune.
        settings: how to tune; the seed also makes the scenes.
        count: scenes per frame.
        watch: told about every frame.
        pictures: folder for pictures of some frames' scenes and of every false detection.
    """
    results: list[SceneResult] = []
    every = max(1, len(frames) // PICTURES_OF_FRAMES)
    for i, frame in enumerate(frames):
        some, heatmaps = measure_frame(frame, bundle, settings, count, i)
        for k, (result, heatmap) in enumerate(zip(some, heatmaps, strict=True), start=1):
            if pictures is not None and (i % every == 0 or result.false_detection):
                _draw(result, heatmap, pictures / f"{frame.name}_{k}.png")
        results += some
        watch("frames", i + 1, len(frames))
    return ScenesReport(settings, bundle, tuple(results))


def measure_frame(
    frame: BenchFrame, bundle: Bundle, settings: Settings, count: int, number_of_frame: int
) -> tuple[list[SceneResult], list[NDArray[np.float32]]]:
    """One frame's scenes, and the heatmap of each."""
    demonstration = frame.read()
    height, width = demonstration.shape[:2]
    center = settings.center_px or (width / 2, height / 2)
    cut = cut_out(demonstration, frame.read_mask(), center)
    rng = np.random.default_rng([settings.seed, number_of_frame])
    scenes = make_scenes(cut, count, rng)
    result = train(prepare(demonstration, bundle, settings), settings, probe=False)
    tuned = result.tuned_object(frame.name)
    found = [tuned.locate(scene.frame) for scene in scenes]
    results = [
        SceneResult(frame, scene, detection)
        for scene, (detection, _) in zip(scenes, found, strict=True)
    ]
    return results, [heatmap for _, heatmap in found]


def _draw(result: SceneResult, heatmap: NDArray[np.float32], path: Path) -> None:
    title = _title(result.frame, result.scene)
    write_png(path, draw_detection(result.scene.frame, heatmap, result.detection, title))


def _title(frame: BenchFrame, scene: Scene) -> str:
    if scene.center_px is None:
        return f"{frame.name}: not here"
    x, y = scene.center_px
    turn = (math.degrees(scene.turn_rad) + 90) % 180 - 90
    return f"{frame.name}: at {x:.0f}, {y:.0f} px, turned {turn:+.0f} deg"


def _scene_json(result: SceneResult) -> dict[str, Any]:
    where = result.scene.center_px
    return {
        "frame": result.frame.name,
        "elongated": result.frame.elongated,
        "present": result.present,
        "true_center_px": None if where is None else [number(value, 2) for value in where],
        "true_turn_deg": number(math.degrees(result.scene.turn_rad), 2),
        "found": result.detection.found,
        "quality": number(result.detection.quality, 4),
        "center_px": [number(value, 2) for value in result.detection.center_px],
        "angle_deg": number(result.detection.angle_deg, 2),
        "center_error_px": number(result.center_error_px, 2),
        "turn_error_deg": number(result.turn_error_deg, 2) if result.present else None,
        "on_object": result.on_object,
    }


def _median(values: Sequence[float]) -> float | None:
    return number(float(np.median(values)), 2) if values else None


def _share(flags: Sequence[bool]) -> float | None:
    return number(float(np.mean(flags)), 4) if flags else None


def _percent(share: float | None) -> str:
    return _with_unit(None if share is None else round(100 * share, 1), " %")


def _with_unit(value: float | None, unit: str) -> str:
    return "-" if value is None else f"{value}{unit}"
