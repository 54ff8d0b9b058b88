"""The command line. Results go to stdout, progress to stderr; errors are one line.

Exit codes: 0 done, 1 what was given cannot be used, 2 the command was called wrongly,
130 interrupted.
"""

import importlib
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer
from rich.console import Console, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)

from qsgm import __version__, defaults, paths
from qsgm.errors import QsgmError

if TYPE_CHECKING:
    from qsgm.bench.calibration import Variant
    from qsgm.blocks import Blocks
    from qsgm.bundle import Bundle, Precision
    from qsgm.finetuning import FinetuneResult
    from qsgm.settings import Settings

EXIT_BAD_INPUT = 1
EXIT_INTERRUPTED = 130
LARGEST_HIDDEN = 1024
# UsageError; typer keeps it in another place in every other version.
USAGE_ERROR = cast(type[Exception], typer.BadParameter.__base__)
LARGEST_SEED = 2**31 - 1  # what numpy and torch take both
# library: the extra that brings it
HOST_LIBRARIES = {"torch": "train", "onnx": "train", "matplotlib": "report"}

# (stage, done, of how many, values to show)
Watch = Callable[..., None]


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
    """Of int8 SGMs' inputs and hidden tensors."""

    EIGHT = "8"
    SIXTEEN = "16"


class Device(StrEnum):
    """Where pretraining runs."""

    CPU = "cpu"
    CUDA = "cuda"


app = typer.Typer(
    name="qsgm",
    help="Fine-tune a network on the device, feed-forward, with int8 synthetic gradients.",
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
bench = typer.Typer(help="Measure what the README states.")
app.add_typer(bench, name="bench")

FrameArgument = Annotated[
    Path, typer.Argument(metavar="OBJECT.PNG", help="One frame with the object at its centre.")
]
SceneArgument = Annotated[Path, typer.Argument(metavar="SCENE.PNG", help="The frame to look at.")]
BundleOption = Annotated[
    Path | None, typer.Option("--bundle", metavar="DIR", help="Bundle; default: the shipped one.")
]
PrecisionOption = Annotated[
    bool | None,
    typer.Option("--int8/--float", help="Precision of the SGMs.", show_default="int8"),
]
MethodOption = Annotated[MethodName, typer.Option(help="Synthetic gradients or backpropagation.")]
LayersOption = Annotated[
    int, typer.Option(min=1, max=defaults.MOST_LAYERS, help="How many of the last to tune.")
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
    bool, typer.Option("--recalibrate", help="Fit the int8 SGMs' ranges to this object's crops.")
]
OptimizerOption = Annotated[
    OptimizerChoice | None, typer.Option(help="Default: the one found best for the method.")
]
EpochsOption = Annotated[int, typer.Option(min=0, max=10_000, help="Passes over 800 crops.")]
SeedOption = Annotated[
    int, typer.Option(min=0, max=LARGEST_SEED, help="Of everything drawn at random.")
]
CenterOption = Annotated[
    str | None,
    typer.Option(metavar="X,Y", help="Object's centre in px; default: the frame's centre."),
]
ThreadsOption = Annotated[int, typer.Option(min=1, max=256, help="Of ONNX Runtime.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
FramesOption = Annotated[
    Path | None,
    typer.Option("--frames", metavar="DIR", help="Demonstrations; default: the calibration set."),
]
LimitOption = Annotated[int | None, typer.Option(min=1, help="At most so many of the frames.")]
ReportOption = Annotated[
    Path | None, typer.Option("-o", "--output", metavar="FILE", help="Also write the JSON here.")
]


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"qsgm {__version__}")
        raise typer.Exit


@app.callback()
def common(
    _version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    """Fine-tune a network on the device, feed-forward, with int8 synthetic gradients."""


@app.command()
def pretrain(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE")] = Path("sgm.pt"),
    seed: SeedOption = 0,
    device: Annotated[Device, typer.Option(help="For the backbone.")] = Device.CPU,
    encoding: Annotated[
        Encoding, typer.Option(help="Of the angle: the paper's breaks at 90 degrees.")
    ] = Encoding.DOUBLE,
    hidden: Annotated[
        str | None,
        typer.Option(metavar="N,N", help="Channels of the SGMs' hidden layers, such as 64,64."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Pretrain network and SGMs on drawn objects (host; needs torch).

    What was interrupted goes on where it stopped when the same command runs again.
    """
    chosen = {} if hidden is None else {"hidden": _channels(hidden)}
    host = _host_module("qsgm.train.pretrain")
    config, loss = host.PretrainConfig(**chosen), host.Loss(encoding=encoding.value)
    with _progress() as watch:
        host.pretrain(output, seed, device.value, watch, config=config, loss=loss)
    if as_json:
        _print_json({"output": str(output), "seed": seed, "device": device.value})
    else:
        typer.echo(f"pretrained: {output}")


@app.command("draw-calibration")
def draw_calibration(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR")] = Path("calib"),
    count: Annotated[
        int, typer.Option(min=1, max=10_000, help="Frames.")
    ] = defaults.CALIBRATION_FRAMES,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Draw a calibration set and the demo's two pictures (host)."""
    host = _host_module("qsgm.train.draw_calibration")
    with _progress() as watch:
        host.draw_calibration_set(output, count, seed, watch)
    if as_json:
        _print_json({"output": str(output), "frames": count, "seed": seed})
    else:
        typer.echo(f"calibration set: {output}")


@app.command("fold-and-quantize")
def fold_and_quantize(
    checkpoint: Annotated[
        Path, typer.Argument(metavar="SGM.PT", help="What `qsgm pretrain` wrote.")
    ],
    calib: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Calibration set; default: the shipped one.")
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR")] = Path("export"),
    blocks: Annotated[
        list[str] | None,
        typer.Option(metavar="A-B,C", help="Also export steps for these blocks; repeatable."),
    ] = None,
    calibrator: Annotated[
        CalibratorName,
        typer.Option(help="Whose ranges; auto: each SGM's best one on held-out frames."),
    ] = CalibratorName.AUTO,
    activation_bits: Annotated[
        ActivationBitsChoice, typer.Option(help="Of the int8 SGMs: one u8 plane, or two.")
    ] = ActivationBitsChoice.SIXTEEN,
    as_json: JsonOption = False,
) -> None:
    """Fold batchnorm, calibrate, quantize to int8, export ONNX graphs (host; needs torch)."""
    more = [_blocks(text) for text in blocks or ()]
    host = _host_module("qsgm.train.export")
    calibration = paths.calibration_folder(calib)
    with _progress() as watch:
        report = host.fold_and_quantize(
            checkpoint,
            calibration,
            output,
            watch,
            blocks=more,
            calibrator=calibrator.value,
            activation_bits=int(activation_bits.value),
        )
    _show(report.to_json(), report, as_json)


@app.command()
def finetune(
    frame: FrameArgument,
    int8: PrecisionOption = None,
    method: MethodOption = MethodName.SGM,
    layers: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=defaults.MOST_LAYERS,
            help="How many of the last to tune.",
            show_default=str(defaults.LAYERS),
        ),
    ] = None,
    blocks: BlocksOption = None,
    trunk: TrunkOption = None,
    optimizer: OptimizerOption = None,
    epochs: EpochsOption = defaults.EPOCHS,
    recalibrate: RecalibrateOption = False,
    seed: SeedOption = 0,
    center: CenterOption = None,
    bundle: BundleOption = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="Default: among this user's objects."),
    ] = None,
    threads: ThreadsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """Tune the network to the object in one frame, on the device."""
    from qsgm.files import check_replaceable
    from qsgm.report import finetune_json, finetune_report
    from qsgm.tuned import DESCRIPTION

    tuned = _tuned(layers, blocks)
    settings = _settings(
        int8, method, tuned, optimizer, epochs, seed, center, threads, blocks, trunk
    )
    settings = replace(settings, recalibrate=recalibrate)
    folder = paths.object_folder(frame) if output is None else output
    check_replaceable(folder, DESCRIPTION)
    result = _finetune(frame, _bundle(bundle), settings)
    name = folder.name if output is None else frame.stem
    report = finetune_json(result, name, folder)
    result.save(folder, name)
    _remember(folder, chosen=output is not None)
    _show(report, finetune_report(result, name), as_json)
    if not as_json:
        typer.echo(f"tuned object: {folder}")


@app.command()
def predict(
    scene: SceneArgument,
    tuned: Annotated[
        Path | None,
        typer.Option("--object", metavar="DIR", help="Tuned object; default: the last one."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="Write a picture here.")
    ] = None,
    threads: ThreadsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """Find the tuned object: where it is, how far to move, how far to turn."""
    from qsgm.images import read_frame, write_png
    from qsgm.pictures import draw_detection
    from qsgm.report import detection_table, predict_json
    from qsgm.tuned import load_object

    found = load_object(paths.last_object_folder() if tuned is None else tuned, threads)
    frame = read_frame(scene)
    detection, heatmap = found.locate(frame)
    name = found.description.name
    if output is not None:
        write_png(output, draw_detection(frame, heatmap, detection, name))
    report = predict_json(detection, heatmap.shape, name, output)
    _show(report, detection_table(detection, name), as_json)
    if output is not None and not as_json:
        typer.echo(f"picture: {output}")


@app.command()
def fidelity(
    frame: FrameArgument,
    int8: PrecisionOption = None,
    layers: Annotated[
        int, typer.Option(min=2, max=defaults.MOST_LAYERS, help="The last one has no SGM.")
    ] = defaults.LAYERS,
    trunk: TrunkOption = None,
    optimizer: OptimizerOption = None,
    epochs: EpochsOption = defaults.EPOCHS,
    seed: SeedOption = 0,
    center: CenterOption = None,
    bundle: BundleOption = None,
    every: Annotated[
        int, typer.Option(min=1, help="Steps from one probe to the next; 25 are an epoch.")
    ] = defaults.PROBE_EVERY,
    output: ReportOption = None,
    picture: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Draw the metrics over the run, a PNG (matplotlib)."),
    ] = None,
    threads: ThreadsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """Compare int8, float and true gradients along one fine-tuning; keeps nothing."""
    from qsgm.report import fidelity_command_json, fidelity_command_report

    chart = None if picture is None else _host_module("qsgm.train.fidelity_chart")
    settings = _settings(
        int8, MethodName.SGM, layers, optimizer, epochs, seed, center, threads, trunk=trunk
    )
    result = _finetune(frame, _bundle(bundle), replace(settings, probe_every=every))
    if not result.probes:
        raise QsgmError(
            f"the bundle {result.prepared.bundle.folder} has no probe for {layers} layers, so "
            "there is nothing to compare; export it again with `qsgm fold-and-quantize`"
        )
    report = fidelity_command_json(result, frame.stem)
    if picture is not None and chart is not None:
        chart.write_fidelity_chart(result, frame.stem, picture)
    _write_report(report, output)
    _show(report, fidelity_command_report(result), as_json)
    if picture is not None and not as_json:
        typer.echo(f"picture: {picture}")


@bench.command("accuracy")
def bench_accuracy(
    frames: FramesOption = None,
    layers: LayersOption = defaults.LAYERS,
    trunk: TrunkOption = None,
    epochs: EpochsOption = defaults.EPOCHS,
    short: Annotated[
        str, typer.Option(metavar="N,N", help="Epochs of further, shorter runs; '' for none.")
    ] = defaults.SHORT_RUNS,
    limit: LimitOption = None,
    seed: SeedOption = 0,
    bundle: BundleOption = None,
    output: ReportOption = None,
    pictures: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Draw learning curves here, JSON beside (matplotlib)."),
    ] = None,
    per_frame: Annotated[bool, typer.Option("--per-frame", help="A line per frame, too.")] = False,
    threads: ThreadsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """Untouched, SGM in int8 and float, backpropagation: on the same crops of every frame.

    Every run length is a run of its own, its rates decaying to nothing at its end. `bp best` is
    backpropagation with the optimizer and rate of a small grid that do best on these very frames:
    more than any user could know beforehand.
    """
    from qsgm.bench.accuracy import measure_accuracy
    from qsgm.bench.accuracy_report import accuracy_report_json, render
    from qsgm.bench.frames import list_frames
    from qsgm.settings import Settings

    charts = None if pictures is None else _host_module("qsgm.train.charts")
    lengths = _run_lengths(short)
    some = list_frames(paths.calibration_folder() if frames is None else frames, limit)
    settings = Settings(
        layers=layers, trunk=_value(trunk), epochs=epochs, seed=seed, threads=threads
    )
    with _progress() as watch:
        report = measure_accuracy(some, _bundle(bundle), settings, lengths, watch)
    values = accuracy_report_json(report)
    _show(values, render(report, per_frame), as_json)
    _write_report(values, output)
    if pictures is not None and charts is not None:
        charts.write_learning_curves(report, pictures / "learning_curves.png")
        _write_report(values, pictures / "accuracy.json")


@bench.command("layers")
def bench_layers(
    frames: FramesOption = None,
    blocks: Annotated[
        list[str] | None,
        typer.Option(metavar="A-B,C", help="Layers in groups; repeatable. Else: all singles."),
    ] = None,
    int8: PrecisionOption = None,
    optimizer: OptimizerOption = None,
    epochs: EpochsOption = defaults.EPOCHS,
    limit: LimitOption = None,
    seed: SeedOption = 0,
    bundle: BundleOption = None,
    output: ReportOption = None,
    threads: ThreadsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """Static SGMs with more and more layers tuned, or in the blocks given, on every frame."""
    from qsgm.bench.frames import list_frames
    from qsgm.bench.layers import measure_layers

    some = list_frames(paths.calibration_folder() if frames is None else frames, limit)
    loaded = _bundle(bundle)
    asked = blocks or [text for text in loaded.blocks if "-" not in text]
    divisions = [_blocks(text) for text in asked]
    settings = _settings(
        int8, MethodName.SGM, defaults.LAYERS, optimizer, epochs, seed, None, threads
    )
    with _progress() as watch:
        report = measure_layers(some, loaded, settings, divisions, watch)
    _show(report.to_json(), report.render(), as_json)
    _write_report(report.to_json(), output)


@bench.command("scenes")
def bench_scenes(
    frames: FramesOption = None,
    scenes: Annotated[int, typer.Option(min=1, max=1000, help="With the object, per frame.")] = 3,
    int8: PrecisionOption = None,
    method: MethodOption = MethodName.SGM,
    layers: LayersOption = defaults.LAYERS,
    optimizer: OptimizerOption = None,
    epochs: EpochsOption = defaults.EPOCHS,
    limit: LimitOption = None,
    seed: SeedOption = 0,
    bundle: BundleOption = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="DIR", help="Write some pictures here.")
    ] = None,
    threads: ThreadsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """Teach on every frame, find its object in scenes made from it, and not on the empty table."""
    from qsgm.bench.frames import list_frames
    from qsgm.bench.scenes import measure_scenes

    some = list_frames(paths.calibration_folder() if frames is None else frames, limit)
    settings = _settings(int8, method, layers, optimizer, epochs, seed, None, threads)
    with _progress() as watch:
        report = measure_scenes(some, _bundle(bundle), settings, scenes, watch, output)
    _show(report.to_json(), report.render(), as_json)


@bench.command("speed")
def bench_speed(
    frames: FramesOption = None,
    layers: LayersOption = defaults.LAYERS,
    trunk: TrunkOption = None,
    epochs: Annotated[
        int, typer.Option(min=1, max=10_000, help="Passes over 800 crops.")
    ] = defaults.EPOCHS,
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="Runs of every variant.")] = 5,
    seed: SeedOption = 0,
    bundle: BundleOption = None,
    output: ReportOption = None,
    threads: ThreadsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """Seconds per stage on the first frame, next to the same job in torch if it is installed."""
    from qsgm.bench.frames import list_frames
    from qsgm.bench.speed import measure_speed, render
    from qsgm.settings import Settings

    frame = list_frames(paths.calibration_folder() if frames is None else frames, 1)[0].path
    settings = Settings(
        layers=layers, trunk=_value(trunk), epochs=epochs, seed=seed, threads=threads
    )
    with _progress() as watch:
        report = measure_speed(frame, _bundle(bundle), settings, repeats, watch)
    _write_report(report, output)
    _show(report, render(report), as_json)


@bench.command("resources")
def bench_resources(
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="Steps of every variant.")] = 15,
    bundle: BundleOption = None,
    output: ReportOption = None,
    threads: ThreadsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """Operations, bytes and time of layers and SGMs: the paper's Table 3, and this bundle's."""
    from qsgm.bench.resources import measure_resources

    with _progress() as watch:
        report = measure_resources(_bundle(bundle), repeats, threads, watch)
    _write_report(report.to_json(), output)
    _show(report.to_json(), report.render(), as_json)


@bench.command("memory")
def bench_memory(
    frames: FramesOption = None,
    processes: Annotated[
        str,
        typer.Option(metavar="N,N", help="Tuned layers of whole processes; '' for none."),
    ] = "3,6",
    trunk: TrunkOption = None,
    epochs: Annotated[int, typer.Option(min=1, max=10_000, help="Of the processes.")] = 1,
    seed: SeedOption = 0,
    bundle: BundleOption = None,
    output: ReportOption = None,
    picture: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw the peaks, a PNG (matplotlib).")
    ] = None,
    threads: ThreadsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """Peak of live activations, SGMs against backpropagation, and whole processes (host)."""
    from qsgm.bench.frames import list_frames
    from qsgm.bench.memory import measure_memory
    from qsgm.settings import Settings

    lengths = _layer_counts(processes)
    host = _host_module("qsgm.train.liveness")
    chart = None if picture is None else _host_module("qsgm.train.memory_chart")
    frame = list_frames(paths.calibration_folder() if frames is None else frames, 1)[0].path
    settings = Settings(trunk=_value(trunk), epochs=epochs, seed=seed, threads=threads)
    with _progress() as watch:
        report = measure_memory(frame, _bundle(bundle), settings, lengths, host.step_memory, watch)
    _write_report(report.to_json(), output)
    if picture is not None and chart is not None:
        chart.write_memory_chart(report, picture)
    _show(report.to_json(), report.render(), as_json)


@bench.command("fidelity")
def bench_fidelity(
    frames: FramesOption = None,
    layers: Annotated[
        int, typer.Option(min=2, max=defaults.MOST_LAYERS, help="The last one has no SGM.")
    ] = defaults.LAYERS,
    epochs: EpochsOption = defaults.EPOCHS,
    limit: LimitOption = None,
    seed: SeedOption = 0,
    bundle: BundleOption = None,
    output: ReportOption = None,
    threads: ThreadsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """int8 gradients against float and true ones along a run on every frame, worst cases named."""
    from qsgm.bench.fidelity import measure_fidelity
    from qsgm.bench.frames import list_frames
    from qsgm.settings import Settings

    some = list_frames(paths.calibration_folder() if frames is None else frames, limit)
    settings = Settings(layers=layers, epochs=epochs, seed=seed, threads=threads)
    with _progress() as watch:
        report = measure_fidelity(some, _bundle(bundle), settings, watch)
    _write_report(report.to_json(), output)
    _show(report.to_json(), report.render(), as_json)


@bench.command("calibration")
def bench_calibration(
    frames: Annotated[
        Path, typer.Option("--frames", metavar="DIR", help="To judge on: none calibrated on.")
    ],
    calib: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Calibration set; default: the shipped one.")
    ] = None,
    variants: Annotated[
        list[str] | None,
        typer.Option(
            "--variant", metavar="A/W/NAME", help="Bits and calibrator; repeatable. Else: eight."
        ),
    ] = None,
    epochs: EpochsOption = defaults.EPOCHS,
    limit: LimitOption = None,
    seed: SeedOption = 0,
    bundle: BundleOption = None,
    output: ReportOption = None,
    picture: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw the study, a PNG (matplotlib).")
    ] = None,
    threads: ThreadsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """Calibration sets from far to near, calibrators and bit widths, judged on other frames."""
    from qsgm.bench.calibration import VARIANTS, measure_calibration
    from qsgm.bench.frames import list_frames
    from qsgm.settings import Settings

    chart = None if picture is None else _host_module("qsgm.train.calibration_chart")
    folder = paths.calibration_folder(calib)
    some = list_frames(frames, limit)
    settings = Settings(epochs=epochs, seed=seed, threads=threads)
    chosen = [_variant(text) for text in variants] if variants else VARIANTS
    with _progress() as watch:
        report = measure_calibration(some, folder, _bundle(bundle), settings, watch, chosen)
    _write_report(report.to_json(), output)
    if picture is not None and chart is not None:
        chart.write_calibration_chart(report, picture)
    _show(report.to_json(), report.render(), as_json)


@bench.command("baselines")
def bench_baselines(
    checkpoint: Annotated[
        Path, typer.Argument(metavar="sgm.pt", help="Gives the start and the static SGMs.")
    ],
    frames: FramesOption = None,
    layers: Annotated[int, typer.Option(min=2, max=4, help="How many to tune.")] = defaults.LAYERS,
    epochs: EpochsOption = defaults.EPOCHS,
    limit: LimitOption = None,
    seed: SeedOption = 0,
    output: ReportOption = None,
    as_json: JsonOption = False,
) -> None:
    """Other systems on the same crops: online SGMs, feedback alignment, target projection (host).

    All in float and in torch, each at the best of a few optimizers and rates on these frames.
    """
    from qsgm.bench.frames import list_frames

    host = _host_module("qsgm.train.baselines.comparison")
    loaded = _host_module("qsgm.train.checkpoint").load_checkpoint(checkpoint)
    some = list_frames(paths.calibration_folder() if frames is None else frames, limit)
    with _progress() as watch:
        tasks = host.tasks_of(loaded, some, layers, seed, watch)
        rows = host.compare(loaded, tasks, layers, epochs, seed, watch)
    values = host.to_json(rows, len(some), epochs)
    _show(values, host.render(rows, len(some)), as_json)
    _write_report(values, output)


@bench.command("paper")
def bench_paper(
    quick: Annotated[
        bool, typer.Option("--quick", help="Sizes at which it runs in seconds and means nothing.")
    ] = False,
    sheet: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a picture of the objects here.")
    ] = None,
    seed: SeedOption = 0,
    output: ReportOption = None,
    as_json: JsonOption = False,
) -> None:
    """The paper's tables again, on drawn objects, and its other systems (host; needs torch)."""
    experiment = _host_module("qsgm.train.paper.experiment")
    host = _host_module("qsgm.train.paper.report")
    config = experiment.QUICK if quick else experiment.PaperConfig()
    if sheet is not None:
        host.write_sheet(sheet, config)
    with _progress() as watch:
        results = experiment.measure_paper(config, seed, watch)
    _write_report(host.to_json(results), output)
    _show(host.to_json(results), host.render(results), as_json)


def run(arguments: Sequence[str]) -> int:
    """Run one command line; the exit code.

    Exceptions that are nobody's fault but this program's are not caught.
    """
    try:
        command = typer.main.get_command(app)
        code = command.main(list(arguments) or ["--help"], prog_name="qsgm", standalone_mode=False)
        code = code if isinstance(code, int) else 0
    except QsgmError as error:
        _complain(f"error: {error}")
        return EXIT_BAD_INPUT
    except USAGE_ERROR as error:
        usage = cast(Any, error)
        command_path = usage.ctx.command_path if usage.ctx else "qsgm"
        message = usage.format_message().rstrip(". ")
        _complain(f"{command_path}: {message}; see `{command_path} --help`")
        return int(usage.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        code = EXIT_INTERRUPTED
    if code == EXIT_INTERRUPTED:  # newer versions of typer turn the exception into the code
        _complain("interrupted")
    return code


def main() -> None:
    """Entry point of the installed command."""
    sys.exit(run(sys.argv[1:]))


def _complain(message: str) -> None:
    """One line on stderr, whatever a file's name may hold."""
    typer.echo(" ".join(message.splitlines()), err=True)


def _show(values: dict[str, Any], table: RenderableType, as_json: bool) -> None:
    if as_json:
        _print_json(values)
    else:
        Console().print(table)


def _print_json(values: dict[str, Any]) -> None:
    from qsgm.report import to_json

    typer.echo(to_json(values))


def _write_report(values: dict[str, Any], path: Path | None) -> None:
    from qsgm.files import write_text_atomic
    from qsgm.report import to_json

    if path is not None:
        write_text_atomic(path, to_json(values) + "\n")


def _bundle(folder: Path | None) -> "Bundle":
    from qsgm.bundle import load_bundle

    return load_bundle(paths.bundle_folder(folder))


def _settings(
    int8: bool | None,
    method: MethodName,
    layers: int,
    optimizer: OptimizerChoice | None,
    epochs: int,
    seed: int,
    center: str | None,
    threads: int,
    blocks: str | None = None,
    trunk: TrunkChoice | None = None,
) -> "Settings":
    from qsgm.settings import Settings

    if method is MethodName.BP and int8:
        _complain("note: backpropagation runs in float; --int8 concerns SGMs only")
    return Settings(
        method=method.value,
        precision="float" if int8 is False or method is MethodName.BP else "int8",
        layers=layers,
        blocks=blocks,
        trunk=_value(trunk),
        optimizer=None if optimizer is None else optimizer.value,
        epochs=epochs,
        seed=seed,
        center_px=_center(center),
        threads=threads,
    )


def _value(trunk: TrunkChoice | None) -> "Precision | None":
    return None if trunk is None else trunk.value


def _tuned(layers: int | None, blocks: str | None) -> int:
    """How many layers to tune: the blocks, if given, say it."""
    if blocks is None:
        return defaults.LAYERS if layers is None else layers
    held = len(_blocks(blocks).layers)
    if layers not in (None, held):
        raise typer.BadParameter(
            f"{blocks} is {held} layers, but --layers says {layers}", param_hint="'--blocks'"
        )
    return held


def _blocks(text: str) -> "Blocks":
    from qsgm.blocks import parse_blocks

    try:
        return parse_blocks(text)
    except QsgmError as error:
        raise typer.BadParameter(str(error), param_hint="'--blocks'") from error


def _variant(text: str) -> "Variant":
    from qsgm.bench.calibration import parse_variant

    try:
        return parse_variant(text)
    except QsgmError as error:
        raise typer.BadParameter(str(error), param_hint="'--variant'") from error


def _channels(text: str) -> tuple[int, ...]:
    try:
        channels = tuple(int(part) for part in text.split(","))
    except ValueError:
        channels = ()
    if not channels or not all(1 <= count <= LARGEST_HIDDEN for count in channels):
        raise typer.BadParameter(
            f"{text!r} gives no channels: expected numbers of 1 to {LARGEST_HIDDEN}, such as 64,64",
            param_hint="'--hidden'",
        )
    return channels


def _run_lengths(text: str) -> tuple[int, ...]:
    try:
        lengths = tuple(int(part) for part in text.split(",")) if text else ()
    except ValueError:
        lengths = (0,)
    if not all(length >= 1 for length in lengths):
        raise typer.BadParameter(
            f"{text!r} gives no run lengths: expected numbers of epochs, such as 1,3",
            param_hint="'--short'",
        )
    return lengths


def _layer_counts(text: str) -> tuple[int, ...]:
    try:
        counts = tuple(int(part) for part in text.split(",")) if text else ()
    except ValueError:
        counts = (0,)
    if not all(1 <= count <= defaults.MOST_LAYERS for count in counts):
        raise typer.BadParameter(
            f"{text!r} gives no numbers of layers: expected 1 to {defaults.MOST_LAYERS}, such as "
            "3,6",
            param_hint="'--processes'",
        )
    return counts


def _center(text: str | None) -> tuple[float, float] | None:
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


def _finetune(frame: Path, bundle: "Bundle", settings: "Settings") -> "FinetuneResult":
    from qsgm.finetuning import finetune as run_finetune
    from qsgm.images import read_demonstration

    demonstration = read_demonstration(frame)
    with _progress() as watch:
        return run_finetune(demonstration, bundle, settings, watch)


def _remember(folder: Path, *, chosen: bool) -> None:
    """Make this the object that `predict` uses; with `-o` that is a convenience, not the point."""
    try:
        paths.remember_object(folder)
    except QsgmError as error:
        if not chosen:
            raise
        _complain(f"note: `qsgm predict` will need --object {folder}: {error}")


def _host_module(name: str) -> Any:
    """A module of the host side, or one line saying what it takes."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing not in HOST_LIBRARIES:
            raise
        raise QsgmError(
            f"this command runs on the host and needs {missing}, which is not installed: "
            f"pip install -c constraints.txt '.[{HOST_LIBRARIES[missing]}]' in a checkout"
        ) from error


@contextmanager
def _progress() -> Iterator[Watch]:
    """A bar per stage on stderr, on a terminal only; yields what is told about progress."""
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description:>10}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[values]}"),
    )
    tasks: dict[str, TaskID] = {}
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as progress:

        def watch(stage: str, done: int, of: int, values: dict[str, float] | None = None) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage, total=of, values="")
            shown = "  ".join(f"{name} {value:.4g}" for name, value in (values or {}).items())
            progress.update(tasks[stage], completed=done, total=of, values=shown)

        yield watch


if __name__ == "__main__":
    main()
