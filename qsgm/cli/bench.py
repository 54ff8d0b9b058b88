"""`qsgm bench`: what the pages in docs/ state, measured."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from qsgm import defaults, paths
from qsgm.cli.console import (
    check_picture,
    draw,
    host_module,
    open_bundle,
    progress,
    show,
    write_report,
)
from qsgm.cli.options import (
    BundleOption,
    EpochsOption,
    FramesOption,
    JsonOption,
    LayersOption,
    LimitOption,
    MethodName,
    MethodOption,
    OptimizerOption,
    PrecisionOption,
    ReportOption,
    SeedOption,
    ThreadsOption,
    TrunkOption,
    parsed,
    parsed_layer_counts,
    parsed_run_lengths,
    parsed_thread_counts,
    settings_of,
)
from qsgm.network import MOST_LAYERS

if TYPE_CHECKING:
    from qsgm.bench.frames import BenchFrame

app = typer.Typer(help="Measure what the pages in docs/ state.")


# What is different in a scene: `qsgm.bench.composing.CONDITIONS`, which takes numpy to load.
SceneCondition = StrEnum(
    "SceneCondition", "same_table another_table beside edges scale tilt half_light blur hidden"
)


@app.command("accuracy")
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
    from qsgm.bench.accuracy import measure_accuracy, render, report_json

    check_picture(pictures)
    lengths = parsed_run_lengths(short)
    some = frames_of(frames, limit)
    settings = settings_of(layers=layers, trunk=trunk, epochs=epochs, seed=seed, threads=threads)
    with progress() as watch:
        report = measure_accuracy(some, open_bundle(bundle), settings, lengths, watch)
    values = report_json(report)
    show(values, render(values, per_frame), as_json)
    write_report(values, output)
    if pictures is not None:
        draw("learning_curves", values, pictures / "learning_curves.png")
        write_report(values, pictures / "accuracy.json")


@app.command("scenes")
def bench_scenes(
    frames: Annotated[
        Path | None,
        typer.Option(
            "--frames", metavar="DIR", help="Demonstrations with masks; default: drawn by the seed."
        ),
    ] = None,
    scenes: Annotated[
        int, typer.Option(min=1, max=1000, help="Per object and condition, with it and without.")
    ] = 3,
    conditions: Annotated[
        list[SceneCondition] | None,
        typer.Option("--condition", help="Compose only these; repeatable. Else: all nine."),
    ] = None,
    int8: PrecisionOption = None,
    method: MethodOption = MethodName.SGM,
    layers: LayersOption = defaults.LAYERS,
    optimizer: OptimizerOption = None,
    epochs: Annotated[
        int, typer.Option(min=0, max=10_000, help="Passes over 800 crops; 0: untouched.")
    ] = defaults.EPOCHS,
    limit: Annotated[
        int | None, typer.Option(min=1, help="Look for at most so many of the objects.")
    ] = None,
    rivals: Annotated[
        list[str] | None,
        typer.Option(
            "--rival", metavar="NAME=COMMAND", help="Another method's process; repeatable."
        ),
    ] = None,
    keep: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write all scenes here, and the truth.")
    ] = None,
    seed: SeedOption = 0,
    bundle: BundleOption = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="DIR", help="Write scenes.png, scenes.json, failures/ here."
        ),
    ] = None,
    threads: ThreadsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """Teach on every frame, find its object in scenes composed from all, and only where it is.

    Nine conditions, from the object's own table to an object a third of which is hidden, each
    scene with the object and without it. Rivals look at the same scenes; how they are called,
    `benchmarks/rivals` shows.
    """
    from qsgm.bench.rivals import parse_rival
    from qsgm.bench.scenes_report import render
    from qsgm.bench.scenes_run import run_scenes

    others = [parsed(parse_rival, text, "--rival") for text in rivals or []]
    settings = settings_of(int8, method, layers, optimizer, epochs, seed, threads)
    loaded, asked = open_bundle(bundle), conditions or [*SceneCondition]
    with progress() as watch:
        values = run_scenes(
            frames=frames,
            limit=limit,
            conditions=asked,
            count=scenes,
            settings=settings,
            bundle=loaded,
            rivals=others,
            keep=keep,
            output=output,
            watch=watch,
        )
    show(values, render(values), as_json)


@app.command("speed")
def bench_speed(
    frames: FramesOption = None,
    layers: LayersOption = defaults.LAYERS,
    trunk: TrunkOption = None,
    epochs: Annotated[
        int, typer.Option(min=1, max=10_000, help="Passes over 800 crops.")
    ] = defaults.EPOCHS,
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="Runs of every variant.")] = 5,
    thread_counts: Annotated[
        str,
        typer.Option(metavar="N,N", help="Further ones, of single steps; '' for none."),
    ] = defaults.THREAD_COUNTS,
    seed: SeedOption = 0,
    bundle: BundleOption = None,
    output: ReportOption = None,
    threads: ThreadsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """Seconds per stage on the first frame, next to the same job in torch if it is installed.

    `benchmarks/peers` compares single steps with those of other frameworks.
    """
    from qsgm.bench.speed import measure_speed, render

    counts = parsed_thread_counts(thread_counts)
    frame = frames_of(frames, 1)[0].path
    settings = settings_of(layers=layers, trunk=trunk, epochs=epochs, seed=seed, threads=threads)
    with progress() as watch:
        report = measure_speed(frame, open_bundle(bundle), settings, repeats, watch, counts)
    write_report(report, output)
    show(report, render(report), as_json)


@app.command("resources")
def bench_resources(
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="Steps of every variant.")] = 15,
    bundle: BundleOption = None,
    output: ReportOption = None,
    threads: ThreadsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """Operations, bytes and time of layers and SGMs: the paper's Table 3, and this bundle's."""
    from qsgm.bench.resources import measure_resources, render

    with progress() as watch:
        values = measure_resources(open_bundle(bundle), repeats, threads, watch)
    write_report(values, output)
    show(values, render(values), as_json)


@app.command("memory")
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
    from qsgm.bench.memory import measure_memory, render

    lengths = parsed_layer_counts(processes)
    host = host_module("qsgm.train.graphs.memory")
    check_picture(picture)
    frame = frames_of(frames, 1)[0].path
    settings = settings_of(trunk=trunk, epochs=epochs, seed=seed, threads=threads)
    with progress() as watch:
        values = measure_memory(
            frame, open_bundle(bundle), settings, lengths, host.step_memory, watch
        )
    write_report(values, output)
    draw("memory", values, picture)
    show(values, render(values), as_json)


@app.command("fidelity")
def bench_fidelity(
    frames: FramesOption = None,
    layers: Annotated[
        int, typer.Option(min=2, max=MOST_LAYERS, help="The last one has no SGM.")
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
    from qsgm.bench.fidelity import measure_fidelity, render

    some = frames_of(frames, limit)
    settings = settings_of(layers=layers, epochs=epochs, seed=seed, threads=threads)
    with progress() as watch:
        values = measure_fidelity(some, open_bundle(bundle), settings, watch)
    write_report(values, output)
    show(values, render(values), as_json)


@app.command("calibration")
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
    from qsgm.bench.calibration import VARIANTS, measure_calibration, parse_variant, render
    from qsgm.bench.frames import list_frames

    check_picture(picture)
    folder = paths.calibration_folder(calib)
    some = list_frames(frames, limit)
    settings = settings_of(epochs=epochs, seed=seed, threads=threads)
    chosen = [parsed(parse_variant, one, "--variant") for one in variants or ()] or VARIANTS
    with progress() as watch:
        report = measure_calibration(some, folder, open_bundle(bundle), settings, watch, chosen)
    values = report.to_json()
    write_report(values, output)
    draw("calibration", values, picture)
    show(values, render(values), as_json)


@app.command("paper")
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
    experiment = host_module("qsgm.train.paper.experiment")
    host = host_module("qsgm.train.paper.report")
    config = experiment.QUICK if quick else experiment.PaperConfig()
    if sheet is not None:
        host.write_sheet(sheet, config)
    with progress() as watch:
        results = experiment.measure_paper(config, seed, watch)
    write_report(host.to_json(results), output)
    show(host.to_json(results), host.render(results), as_json)


def frames_of(folder: Path | None, limit: int | None) -> list["BenchFrame"]:
    """Demonstrations of a folder, or the calibration set's."""
    from qsgm.bench.frames import list_frames

    return list_frames(paths.calibration_folder() if folder is None else folder, limit)
