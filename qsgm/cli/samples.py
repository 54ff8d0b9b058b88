"""What the commands do for networks of one's own; see :mod:`qsgm.samples`."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from qsgm.cli.console import host_module, print_json, progress, show, tell
from qsgm.errors import QsgmError, as_text
from qsgm.files import read_file, sha256

if TYPE_CHECKING:
    from qsgm.bundle import Bundle
    from qsgm.manifest import Recipe
    from qsgm.samples.task import SampleTask
    from qsgm.samples.teach import SamplesResult
    from qsgm.tune.settings import Settings

TaskOption = Annotated[
    Path | None,
    typer.Option(
        "--task", metavar="FILE.py", help="A network of your own: what defines it; default: grasp."
    ),
]
_MOST_BYTES = 1_000_000


def pretrain_task(
    file: Path, output: Path, seed: int, device: str, chosen: dict[str, Any], as_json: bool
) -> None:
    """`qsgm pretrain --task`."""
    task = _host_task(file)
    host = host_module("qsgm.train.samples.build")
    sizes = host.usual_config(task, **chosen)
    source = sha256(read_file(file, _MOST_BYTES, "a task file"))
    with progress() as watch:
        said = f" --task {as_text(file.name)}"
        made = host.pretrain_samples(task, output, seed, device, watch, sizes, None, said, source)
    first = made.card["config"]["first_rates"]
    learnt = next(rates for rates in made.rates.values() if len(rates) == len(first))
    if as_json:
        values = {"output": str(output), "seed": seed, "device": device, "task": task.name}
        recipes = {text: [asdict(one) for one in some] for text, some in made.recipes.items()}
        rates = {"first_rates": first, "rates": dict(made.rates), "recipes": recipes}
        print_json(values | rates)
    else:
        started, ended = (", ".join(f"{rate:.2g}" for rate in some) for some in (first, learnt))
        typer.echo(f"rates of the last {len(first)} layers: from {started} to {ended}")
        for text, (usual, *_) in made.recipes.items():
            typer.echo(f"layers {text}: {_paces(usual)}")
        tell("pretrained", output)


def _paces(recipe: "Recipe") -> str:
    """An optimizer, and where its rates start in runs of the lengths that were tried."""
    paces = [
        f"{', '.join(f'{rate:.2g}' for rate in recipe.rates_over(steps))} over {steps} steps"
        for steps, _ in recipe.gains
    ]
    return f"{recipe.optimizer}, {'; '.join(paces)}"


def export_task(
    file: Path, checkpoint: Path, output: Path, chosen: dict[str, Any], as_json: bool
) -> None:
    """`qsgm fold-and-quantize --task`."""
    task = _host_task(file)
    host = host_module("qsgm.train.samples.build")
    options = replace(host.USUAL, **chosen)
    with progress() as watch:
        report = host.export_samples(task, checkpoint, output, watch, options)
    show(report.to_json(), report, as_json)


def is_of_samples(bundle: "Bundle", file: Path | None) -> bool:
    """Whether a bundle is tuned on samples, not on frames that show an object."""
    from qsgm.samples.taskfile import GRASP

    return file is not None or bundle.manifest.task.name != GRASP


def bundles_task(bundle: "Bundle", file: Path | None) -> "SampleTask":
    """The task that a bundle of samples is of."""
    from qsgm.samples.taskfile import task_of_bundle

    return task_of_bundle(bundle, _device_task(file))


def with_usual(
    bundle: "Bundle", task: "SampleTask", settings: "Settings", **said: object
) -> "Settings":
    """Settings as they are usual for samples, where what was said of one, by its name, is None."""
    from qsgm.samples.teach import usual_settings

    usual = usual_settings(bundle, task)
    left_open = [name for name, value in said.items() if value is None]
    return replace(settings, **{name: getattr(usual, name) for name in left_open})


def learn_task(
    task: "SampleTask", shown: Sequence[Path], bundle: "Bundle", settings: "Settings"
) -> "SamplesResult":
    """`qsgm finetune` with a bundle of samples."""
    from qsgm.samples.taskfile import read_samples
    from qsgm.samples.teach import learn

    samples = [read_samples(task, path) for path in shown]
    with progress() as watch:
        return learn(samples, bundle, task, settings, watch)


def show_learnt(result: "SamplesResult", folder: Path, name: str, as_json: bool) -> None:
    """Scores by name, fidelity, seconds."""
    from qsgm.samples.report import learnt_json, learnt_report

    show(learnt_json(result, name, folder), learnt_report(result, name), as_json)


def predict_task(
    folders: Sequence[Path],
    file: Path | None,
    samples: Path,
    threads: int,
    as_json: bool,
    grasping: Mapping[str, bool],
) -> bool:
    """`qsgm predict` with a tuned network; False where the folders are grasping's."""
    from qsgm.samples.arrays import ArraysTask
    from qsgm.samples.report import answers_json, answers_table
    from qsgm.samples.taskfile import read_samples, task_for, tuned_of
    from qsgm.samples.tuned import load_network, task_named_in

    others = [one for one in folders if task_named_in(one) is not None]
    if not others:
        if file is not None:
            raise QsgmError(f"{folders[0]} is of the task 'grasp', which takes no --task")
        return False
    folder = others[0]
    if len(folders) > 1:
        raise QsgmError(f"{folder} is a tuned network, which answers alone; pass one --object")
    refuse_options(**grasping)
    network = load_network(folder, threads)
    kept, given = network.task, _device_task(file)
    task: SampleTask = ArraysTask(kept.name, kept.network, kept.heads, tuned_of(kept))
    if given is not None:
        task = task_for(kept, f"the tuned network {folder}", given)
    seen = read_samples(task, samples)
    outputs = network.answers(seen.inputs)
    scores = None if seen.labels is None else task.scores(outputs, seen.labels)
    values = answers_json(network.name, kept.name, kept.heads, outputs, scores)
    show(values, answers_table(network.name, kept.heads, outputs, scores), as_json)
    return True


def refuse_options(**given: bool) -> None:
    """Refuse what concerns grasping only. Raises QsgmError."""
    for name, there in given.items():
        if there:
            option = f"--{name.strip('_').replace('_', '-')}"
            raise QsgmError(f"{option} concerns the task `grasp` only; leave it out")


def _device_task(file: Path | None) -> "SampleTask | None":
    """What a task file defines; None without one, and for the built-in one's JSON file."""
    from qsgm.samples.taskfile import load_task

    return None if file is None or file.suffix == ".json" else load_task(file)


def _host_task(file: Path) -> "SampleTask":
    """What is pretrained and exported."""
    if file.suffix == ".json":
        found: SampleTask = host_module("qsgm.train.samples.arrays").load_arrays_task(file)
        return found
    from qsgm.samples.taskfile import load_task

    return load_task(file)
