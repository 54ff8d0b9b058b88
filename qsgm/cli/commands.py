"""The commands themselves; those of `bench` are in :mod:`qsgm.cli.bench`."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from qsgm import defaults, paths
from qsgm.cli.console import (
    check_output,
    check_picture,
    draw,
    host_module,
    open_bundle,
    progress,
    show,
    tell,
    tell_or_print,
    write_report,
)
from qsgm.cli.options import (
    ActivationBitsChoice,
    BlocksOption,
    BundleOption,
    CalibratorName,
    CenterOption,
    CentersOption,
    Device,
    DistanceOption,
    Encoding,
    FrameArgument,
    FramesArgument,
    JsonOption,
    LessonEpochsOption,
    MethodName,
    MethodOption,
    ObjectsOption,
    OptimizerOption,
    OthersOption,
    PrecisionOption,
    RecalibrateOption,
    ReportOption,
    SceneArgument,
    SeedOption,
    SpanOption,
    StreamOption,
    ThreadsOption,
    TrunkOption,
    parsed_blocks,
    parsed_center,
    parsed_centers,
    parsed_channels,
    settings_of,
    tuned_layers,
)
from qsgm.cli.samples import (
    TaskOption,
    bundles_task,
    export_task,
    is_of_samples,
    learn_task,
    predict_task,
    pretrain_task,
    refuse_options,
    show_learnt,
    with_usual,
)
from qsgm.cli.streams import complain
from qsgm.errors import QsgmError, as_text
from qsgm.network import MOST_LAYERS

if TYPE_CHECKING:
    from qsgm.bundle import Bundle
    from qsgm.grasp.others import Other
    from qsgm.grasp.source import Demonstration
    from qsgm.grasp.taught import FinetuneResult
    from qsgm.tune.result import Result
    from qsgm.tune.settings import Settings

app = typer.Typer()


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
    task: TaskOption = None,
    as_json: JsonOption = False,
) -> None:
    """Pretrain network and SGMs on drawn objects, or on a task's samples (host; needs torch).

    What was interrupted goes on where it stopped when the same command runs again.
    """
    chosen = {} if hidden is None else {"hidden": parsed_channels(hidden)}
    if task is not None:
        refuse_options(encoding=encoding is not Encoding.DOUBLE)
        pretrain_task(task, output, seed, device.value, chosen, as_json)
        return
    host = host_module("qsgm.train.grasp.pretrain")
    config, drawn = host.PretrainConfig(**chosen), host.DrawnGrasping(encoding=encoding.value)
    with progress() as watch:
        host.pretrain_grasping(drawn, output, seed, device.value, watch, config)
    values = {"output": str(output), "seed": seed, "device": device.value}
    tell_or_print("pretrained", output, values, as_json)


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
    host = host_module("qsgm.train.grasp.draw_calibration")
    with progress() as watch:
        host.draw_calibration_set(output, count, seed, watch)
    values = {"output": str(output), "frames": count, "seed": seed}
    tell_or_print("calibration set", output, values, as_json)


@app.command("teach-comparer")
def teach_comparer(
    checkpoint: Annotated[
        Path, typer.Argument(metavar="SGM.PT", help="What `qsgm pretrain` wrote.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE")] = Path("comparer.json"),
    seed: SeedOption = 0,
    device: Annotated[Device, typer.Option(help="To learn on.")] = Device.CPU,
    processes: Annotated[int, typer.Option(min=1, max=256, help="That draw.")] = 1,
    as_json: JsonOption = False,
) -> None:
    """Teach the network that tells the object from others on drawn ones (host; a GPU's work)."""
    host = host_module("qsgm.train.grasp.teach_comparer")
    with progress() as watch:
        host.teach_comparer(checkpoint, output, seed, device.value, processes, watch)
    values = {"output": str(output), "seed": seed, "device": device.value}
    tell_or_print("comparer", output, values, as_json)


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
    processes: Annotated[
        int | None,
        typer.Option(min=1, max=256, help="One core each; default: one for every core, 4 at most."),
    ] = None,
    task: TaskOption = None,
    as_json: JsonOption = False,
) -> None:
    """Fold batchnorm, calibrate, quantize to int8, export ONNX graphs (host; needs torch)."""
    more = [parsed_blocks(text) for text in blocks or ()]
    bits = int(activation_bits.value)
    chosen = {"blocks": tuple(more), "calibrator": calibrator.value, "activation_bits": bits}
    if task is not None:
        refuse_options(calib=calib is not None, processes=processes is not None)
        export_task(task, checkpoint, output, chosen, as_json)
        return
    host = host_module("qsgm.train.grasp.export")
    chosen["processes"] = processes or host_module("qsgm.train.processes").usual_count()
    calibration, options = paths.calibration_folder(calib), host.ExportOptions(**chosen)
    with progress() as watch:
        report = host.fold_and_quantize(checkpoint, calibration, output, watch, options)
    show(report.to_json(), report, as_json)


@app.command()
def slim(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR")],
    blocks: Annotated[
        str, typer.Option(metavar="A-B,C", help="The one way of tuning that stays.")
    ] = defaults.SLIM_BLOCKS,
    without_scan: Annotated[
        bool,
        typer.Option(
            "--without-scan", help="All crops at once, for runtimes that lack ONNX's Scan."
        ),
    ] = False,
    bundle: BundleOption = None,
    as_json: JsonOption = False,
) -> None:
    """Make a small bundle of a whole one: what one way of tuning takes (host; needs onnx)."""
    host = host_module("qsgm.train.slim")
    whole, kept = open_bundle(bundle), parsed_blocks(blocks)
    report = host.slim_bundle(whole, kept, output, without_scan=without_scan)
    show(report.to_json(), report, as_json)


@app.command()
def finetune(
    frames: FramesArgument,
    int8: PrecisionOption = None,
    method: MethodOption = MethodName.SGM,
    layers: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=MOST_LAYERS,
            help="How many of the last to tune.",
            show_default=str(defaults.LAYERS),
        ),
    ] = None,
    blocks: BlocksOption = None,
    trunk: TrunkOption = None,
    optimizer: OptimizerOption = None,
    epochs: LessonEpochsOption = None,
    recalibrate: RecalibrateOption = False,
    stream: StreamOption = False,
    seed: SeedOption = 0,
    center: CentersOption = None,
    span: SpanOption = None,
    others: OthersOption = None,
    bundle: BundleOption = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="Default: among this user's objects."),
    ] = None,
    threads: ThreadsOption = 1,
    task: TaskOption = None,
    as_json: JsonOption = False,
) -> None:
    """Tune the network to the object in one frame or several, on the device."""
    from qsgm.files import check_replaceable
    from qsgm.grasp.report import finetune_report
    from qsgm.grasp.taught import finetune_json
    from qsgm.tuned_folder import DESCRIPTION

    tuned, first = tuned_layers(layers, blocks), frames[0]
    centers = parsed_centers(center, len(frames))
    settings = settings_of(int8, method, tuned, optimizer, epochs, seed, threads, blocks, trunk)
    if recalibrate and int8 is None and settings.method == "sgm":
        settings = replace(settings, precision="int8")  # those are the SGMs that have ranges
    settings = replace(settings, recalibrate=recalibrate, stream=stream)
    folder = paths.object_folder(first) if output is None else output
    check_replaceable(folder, DESCRIPTION)
    opened, name = open_bundle(bundle), as_text(paths.name_of(first))
    if is_of_samples(opened, task):
        refuse_options(center=bool(center), span=span is not None, **{"not": bool(others)})
        own = bundles_task(opened, task)
        settings = with_usual(opened, own, settings, layers=layers or blocks, epochs=epochs)
        learnt = learn_task(own, frames, opened, settings)
        learnt.save(folder, name)
        _remember(folder, chosen=output is not None)
        show_learnt(learnt, folder, name, as_json)
        if not as_json:
            tell("tuned network", folder)
        return
    result = _finetune(frames, centers, others or (), opened, settings, span)
    report = finetune_json(result, name, folder)
    result.save(folder, name)
    _remember(folder, chosen=output is not None)
    show(report, finetune_report(result, name), as_json)
    if not as_json:
        tell("tuned object", folder)


@app.command()
def predict(
    scene: SceneArgument,
    tuned: ObjectsOption = None,
    everything: Annotated[
        bool, typer.Option("--all", help="List every instance of the object.")
    ] = False,
    any_distance: DistanceOption = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="Write a picture here.")
    ] = None,
    threads: ThreadsOption = 1,
    task: TaskOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find the tuned object, or several: where it is, how far to move, how far to turn.

    With several, --json describes the surest one and lists all of them as `objects`, each entry
    with its name and whether it was `found`. With one, `objects` is what --all found of it.
    """
    from qsgm.grasp.sights import look_for_each, sights_json, sights_picture, sights_table
    from qsgm.images import check_png_name, read_frame, write_png
    from qsgm.store import find_objects, load_objects

    if everything and any_distance:
        raise typer.BadParameter("--all looks at the demonstration's distance only")
    folders = find_objects(tuned or ())
    grasping = {"all": everything, "any_distance": bool(any_distance), "output": output is not None}
    if predict_task(folders, task, scene, threads, as_json, grasping):
        return
    if output is not None:
        check_png_name(output)
        check_output(output, scene)
    objects = load_objects(folders, threads)
    frame = read_frame(scene)
    anywhere = not everything if any_distance is None else any_distance
    sights = look_for_each(objects, frame, everything=everything, any_distance=anywhere)
    if output is not None:
        write_png(output, sights_picture(frame, sights))
    show(sights_json(sights, output), sights_table(sights), as_json)
    if output is not None and not as_json:
        tell("picture", output)


@app.command()
def fidelity(
    frame: FrameArgument,
    int8: Annotated[
        bool, typer.Option("--int8/--float", help="Precision of the SGMs that drive the run.")
    ] = True,
    layers: Annotated[
        int | None,
        typer.Option(
            min=2,
            max=MOST_LAYERS,
            help="The last one has no SGM.",
            show_default=str(defaults.LAYERS),
        ),
    ] = None,
    trunk: TrunkOption = None,
    optimizer: OptimizerOption = None,
    epochs: LessonEpochsOption = None,
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
    task: TaskOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compare int8, float and true gradients along one fine-tuning; keeps nothing."""
    from qsgm.tune.report import fidelity_command_json, fidelity_command_report

    check_picture(picture)
    tuned = tuned_layers(layers, None)
    settings = settings_of(
        int8, MethodName.SGM, tuned, optimizer, epochs, seed, threads, trunk=trunk
    )
    settings = replace(settings, probe_every=every)
    for path in (output, picture):
        check_output(path, frame)
    opened = open_bundle(bundle)
    result: Result
    if is_of_samples(opened, task):
        refuse_options(center=center is not None)
        own = bundles_task(opened, task)
        settings = with_usual(opened, own, settings, layers=layers, epochs=epochs)
        if settings.layers == 1:
            raise QsgmError("one layer has no SGM, so there is nothing to compare; pass --layers 2")
        result = learn_task(own, [frame], opened, settings)
    else:
        result = _finetune([frame], [parsed_center(center)], (), opened, settings)
    if not result.probes:
        raise QsgmError(
            f"the bundle {opened.folder} has no probe for {settings.layers} layers, so there is "
            "nothing to compare; export it again with `qsgm fold-and-quantize`"
        )
    report = fidelity_command_json(result, as_text(paths.name_of(frame)))
    draw("fidelity_over_run", report, picture)
    write_report(report, output)
    show(report, fidelity_command_report(result), as_json)
    if picture is not None and not as_json:
        tell("picture", picture)


def _finetune(
    frames: Sequence[Path],
    centers: Sequence[tuple[float, float] | None],
    others: Sequence[Path],
    bundle: "Bundle",
    settings: "Settings",
    span_px: float | None = None,
) -> "FinetuneResult":
    from qsgm.grasp.teach import finetune as run_finetune

    demonstrations = [_demonstration(*one) for one in zip(frames, centers, strict=True)]
    named = [_other(path) for path in others]
    with progress() as watch:
        return run_finetune(demonstrations, bundle, settings, watch, named, span_px)


def _demonstration(path: Path, center_px: tuple[float, float] | None) -> "Demonstration":
    """A frame with its object at a point, or at its centre."""
    from qsgm.grasp.source import Demonstration
    from qsgm.images import read_demonstration

    frame = read_demonstration(path)
    return Demonstration(frame, center_px or (frame.shape[1] / 2, frame.shape[0] / 2))


def _other(path: Path) -> "Other":
    """A thing to tell the object apart from: what a frame shows, or a tuned object."""
    from qsgm.grasp.others import other_in
    from qsgm.grasp.tuned import load_object

    return (
        load_object(path).as_other()
        if paths.is_folder(path)
        else other_in(_demonstration(path, None))
    )


def _remember(folder: Path, *, chosen: bool) -> None:
    """Make this the object that `predict` uses; with `-o` that is a convenience, not the point."""
    try:
        paths.remember_object(folder)
    except QsgmError as error:
        if not chosen:
            raise
        complain(f"note: `qsgm predict` will need --object {folder}: {error}")
