"""A bundle of one's own network in one call: pretrain, fold, calibrate, export."""

from pathlib import Path

from qsgm.errors import QsgmError
from qsgm.progress import Progress, ignore
from qsgm.samples.task import SampleTask
from qsgm.samples.taskfile import task_for
from qsgm.train.checkpoint import Checkpoint, load_checkpoint
from qsgm.train.export import ExportOptions, export_bundle
from qsgm.train.export_report import ExportReport
from qsgm.train.model.net import ConvNet
from qsgm.train.pretraining.pretrain import PretrainConfig, pretrain
from qsgm.train.samples.drawn import DrawnLessons, DrawnSamples, usual_config

USUAL = ExportOptions(epochs=5, paying=True)


def build(
    task: SampleTask,
    out: Path,
    net: ConvNet | None = None,
    *,
    checkpoint: Path | None = None,
    seed: int = 0,
    device: str = "cpu",
    config: PretrainConfig | None = None,
    options: ExportOptions = USUAL,
    watch: Progress = ignore,
) -> ExportReport:
    """Make the bundle that a device tunes.

    Args:
        task: its `draw` gives what is learnt from.
        out: the bundle's folder: absent, empty, or an earlier bundle.
        net: a trained network, see :func:`qsgm.train.from_torch`; None: it is trained first.
        checkpoint: where that is kept; None: beside the bundle, `<out>.pt`.
        seed: of everything drawn at random.
        device: `cpu` or `cuda`, for the network's own training.
        config: sizes; None: :func:`qsgm.train.usual_config`.
        options: what the bundle is to hold.
        watch: told about progress.

    Raises:
        QsgmError: network, heads and samples do not go together, training diverged, or something
            cannot be written.
    """
    kept = checkpoint or out.with_name(f"{out.name}.pt")
    pretrain_samples(task, kept, seed, device, watch, config, net)
    return export_samples(task, kept, out, watch, options)


def pretrain_samples(
    task: SampleTask,
    output: Path,
    seed: int = 0,
    device: str = "cpu",
    watch: Progress = ignore,
    config: PretrainConfig | None = None,
    net: ConvNet | None = None,
    arguments: str = " --task FILE.py",
    source: str = "",
) -> Checkpoint:
    """Pretrain and write `output`; arguments and errors as :func:`pretrain` and `build` have."""
    if net is not None and net.network != task.network:
        raise QsgmError(
            f"the trained network is not the one of the task {task.name!r}: write its `network` "
            "into the task"
        )
    sizes = config or usual_config(task)
    drawn = DrawnSamples(task, source)
    return pretrain(drawn, output, seed, device, watch, sizes, arguments=arguments, trained=net)


def export_samples(
    task: SampleTask,
    checkpoint: Path,
    out: Path,
    watch: Progress = ignore,
    options: ExportOptions = USUAL,
) -> ExportReport:
    """Fold, calibrate, quantize, export; errors as `build` has them."""
    task = task_for(load_checkpoint(checkpoint).task, str(checkpoint), task)
    return export_bundle(checkpoint, DrawnLessons(DrawnSamples(task)), out, {}, watch, options)
