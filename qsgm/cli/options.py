"""What the commands take: choices, options, and what their texts mean."""

import math
from collections.abc import Callable
from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from qsgm import defaults
from qsgm.cli.streams import complain
from qsgm.errors import QsgmError
from qsgm.network import MOST_LAYERS

if TYPE_CHECKING:
    from qsgm.blocks import Blocks
    from qsgm.tune.settings import Settings

Value = TypeVar("Value")
LARGEST_HIDDEN = 1024
MOST_THREADS = 256
LARGEST_SEED = 2**31 - 1  # what numpy and torch take both


class MethodName(StrEnum):
    """Where the tuned layers get their gradients from."""

    SGM = "sgm"
    BP = "bp"


class OptimizerChoice(StrEnum):
    """What is done with the gradients."""

    SGD = "sgd"
    ADAM = "adam"


class TrunkChoice(StrEnum):
    """How the frozen layers are computed."""

    INT8 = "int8"
    FLOAT = "float"


class Encoding(StrEnum):
    """What the two angle channels stand for."""

    DOUBLE = "double"
    PAPER = "paper"


class CalibratorName(StrEnum):
    """Whose ranges int8 SGMs get."""

    AUTO = "auto"
    MINMAX = "minmax"
    PERCENTILE = "percentile"
    MSE = "mse"
    ENTROPY = "entropy"


class ActivationBitsChoice(StrEnum):
    """Bits of int8 SGMs' inputs and hidden tensors."""

    EIGHT = "8"
    SIXTEEN = "16"


class Device(StrEnum):
    """Where pretraining runs."""

    CPU = "cpu"
    CUDA = "cuda"


FrameArgument = Annotated[
    Path, typer.Argument(metavar="OBJECT.PNG", help="One frame with the object at its centre.")
]
FramesArgument = Annotated[
    list[Path],
    typer.Argument(
        metavar="OBJECT.PNG...",
        help="Frames with the object at their centre; the first is angle 0.",
    ),
]
OthersOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--not",
        metavar="IMAGE|OBJECT",
        help="A thing to tell it apart from: a frame of it, or its tuned object; repeatable.",
    ),
]
SpanOption = Annotated[
    float | None,
    typer.Option(
        "--span", min=1, max=100_000, metavar="PX", help="Object's long side; default: measured."
    ),
]
CentersOption = Annotated[
    list[str] | None,
    typer.Option(
        "--center",
        metavar="X,Y",
        help="Object's centre in px, once or for every frame; default: the frames' centres.",
    ),
]
SceneArgument = Annotated[
    Path, typer.Argument(metavar="SCENE.PNG", help="The frame to look at; - is what is piped in.")
]
ObjectsOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--object",
        metavar="DIR|NAME",
        help="Tuned object, a folder or one of yours by name; repeatable; default: the last one.",
    ),
]
_FURTHER_LOOKS = "Where it is not found, look more closely and at half to twice the distance, too."
AnyDistanceOption = Annotated[bool, typer.Option("--any-distance", help=_FURTHER_LOOKS)]
DistanceOption = Annotated[
    bool | None,
    typer.Option(
        "--any-distance/--same-distance", help=_FURTHER_LOOKS, show_default="any, but with --all"
    ),
]
BundleOption = Annotated[
    Path | None, typer.Option("--bundle", metavar="DIR", help="Bundle; default: the shipped one.")
]
PrecisionOption = Annotated[
    bool | None,
    typer.Option("--int8/--float", help="Precision of the SGMs.", show_default=defaults.PRECISION),
]
MethodOption = Annotated[MethodName, typer.Option(help="Synthetic gradients or backpropagation.")]
LayersOption = Annotated[
    int, typer.Option(min=1, max=MOST_LAYERS, help="How many of the last to tune.")
]
BlocksOption = Annotated[
    str | None,
    typer.Option(
        metavar="A-B,C",
        help="Groups of the last layers that share one gradient, such as 1-4,5,6; default: none.",
    ),
]
TrunkOption = Annotated[
    TrunkChoice | None, typer.Option(help="Precision of the frozen layers; default: the bundle's.")
]
RecalibrateOption = Annotated[
    bool,
    typer.Option("--recalibrate", help="Fit the ranges of the SGMs, then int8, to this object."),
]
StreamOption = Annotated[
    bool,
    typer.Option(
        "--stream",
        help="Keep no crops' features, make them again for every batch: less memory with 5 or 6 "
        "layers, and longer.",
    ),
]
OptimizerOption = Annotated[
    OptimizerChoice | None, typer.Option(help="Default: the one found best for the method.")
]
EpochsOption = Annotated[int, typer.Option(min=0, max=10_000, help="Passes over 800 crops.")]
LessonEpochsOption = Annotated[
    int | None,
    typer.Option(
        min=0,
        max=10_000,
        help="Passes over 800 crops.",
        show_default=f"{defaults.EPOCHS}; over samples of one's own {defaults.SAMPLE_EPOCHS}",
    ),
]
SeedOption = Annotated[
    int, typer.Option(min=0, max=LARGEST_SEED, help="Of everything drawn at random.")
]
CenterOption = Annotated[
    str | None,
    typer.Option(metavar="X,Y", help="Object's centre in px; default: the frame's centre."),
]
ThreadsOption = Annotated[int, typer.Option(min=1, max=MOST_THREADS, help="Of ONNX Runtime.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
FramesOption = Annotated[
    Path | None,
    typer.Option("--frames", metavar="DIR", help="Demonstrations; default: the calibration set."),
]
LimitOption = Annotated[int | None, typer.Option(min=1, help="At most so many of the frames.")]
ReportOption = Annotated[
    Path | None, typer.Option("-o", "--output", metavar="FILE", help="Also write the JSON here.")
]


def settings_of(
    int8: bool | None = None,
    method: MethodName = MethodName.SGM,
    layers: int = defaults.LAYERS,
    optimizer: OptimizerChoice | None = None,
    epochs: int | None = None,
    seed: int = 0,
    threads: int = 1,
    blocks: str | None = None,
    trunk: TrunkChoice | None = None,
) -> "Settings":
    """The settings that a command's options come to."""
    from qsgm.tune.settings import Settings

    if method is MethodName.BP and int8:
        complain("note: backpropagation runs in float; --int8 concerns SGMs only")
    return Settings(
        method=method.value,
        precision="int8" if int8 and method is MethodName.SGM else "float",
        layers=layers,
        blocks=blocks,
        trunk=None if trunk is None else trunk.value,
        optimizer=None if optimizer is None else optimizer.value,
        epochs=defaults.EPOCHS if epochs is None else epochs,
        seed=seed,
        threads=threads,
    )


def tuned_layers(layers: int | None, blocks: str | None) -> int:
    """How many layers to tune: the blocks, if given, say it."""
    if blocks is None:
        return defaults.LAYERS if layers is None else layers
    held = len(parsed_blocks(blocks).layers)
    if layers not in (None, held):
        raise typer.BadParameter(
            f"{blocks} is {held} layers, but --layers says {layers}", param_hint="'--blocks'"
        )
    return held


def parsed_blocks(text: str) -> "Blocks":
    """Layers in groups, such as 1-4,5,6."""
    from qsgm.blocks import parse_blocks

    return parsed(parse_blocks, text, "--blocks")


def parsed(parse: Callable[[str], Value], text: str, option: str) -> Value:
    """What an option's text means; where it means nothing, the command was called wrongly."""
    try:
        return parse(text)
    except QsgmError as error:
        raise typer.BadParameter(str(error), param_hint=f"'{option}'") from error


def parsed_channels(text: str) -> tuple[int, ...]:
    """Channels of hidden layers, such as 64,64."""
    expected = f"no channels: expected numbers of 1 to {LARGEST_HIDDEN}, such as 64,64"
    return _numbers(text, "--hidden", LARGEST_HIDDEN, expected)


def parsed_run_lengths(text: str) -> tuple[int, ...]:
    """Epochs of runs, such as 1,3, or none."""
    expected = "no run lengths: expected numbers of epochs, such as 1,3"
    return _numbers(text, "--short", math.inf, expected) if text else ()


def parsed_layer_counts(text: str) -> tuple[int, ...]:
    """How many layers to tune, such as 3,6, or none."""
    expected = f"no numbers of layers: expected 1 to {MOST_LAYERS}, such as 3,6"
    return _numbers(text, "--processes", MOST_LAYERS, expected) if text else ()


def parsed_thread_counts(text: str) -> tuple[int, ...]:
    """Numbers of threads, such as 1,2, or none."""
    expected = f"no numbers of threads: expected 1 to {MOST_THREADS}, such as 1,2"
    return _numbers(text, "--thread-counts", MOST_THREADS, expected) if text else ()


def _numbers(text: str, option: str, most: float, expected: str) -> tuple[int, ...]:
    """Whole numbers from 1 on, between commas."""
    with suppress(ValueError):
        found = tuple(int(part) for part in text.split(","))
        if all(1 <= number <= most for number in found):
            return found
    raise typer.BadParameter(f"{text!r} gives {expected}", param_hint=f"'{option}'")


def parsed_centers(texts: list[str] | None, frames: int) -> list[tuple[float, float] | None]:
    """A point for each of so many frames: one that all share, or one for each."""
    points = [parsed_center(text) for text in texts or ()]
    if len(points) in (0, 1):
        return (points or [None]) * frames
    if len(points) != frames:
        raise typer.BadParameter(
            f"{len(points)} points for {frames} frames: expected one, or one for every frame",
            param_hint="'--center'",
        )
    return points


def parsed_center(text: str | None) -> tuple[float, float] | None:
    """A point (x, y) in px, such as 320,240; None: the middle of the frame."""
    if text is None:
        return None
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError as error:
        raise typer.BadParameter(
            f"{text!r} is not a point: expected x,y in px, such as 320,240",
            param_hint="'--center'",
        ) from error
    return x, y
