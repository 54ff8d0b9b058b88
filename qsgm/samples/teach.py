"""Tuning a network of one's own on the device.

samples = task.read(Path("mine.npz"))
result = learn(samples, load_bundle(Path("mine")), task)
result.save(Path("tuned"), "mine")
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort

from qsgm import __version__, defaults
from qsgm.bundle import Bundle
from qsgm.progress import Progress
from qsgm.samples.lesson import Samples, checked_samples, fallen
from qsgm.samples.report import run_json
from qsgm.samples.task import SampleTask
from qsgm.samples.taskfile import task_of_bundle
from qsgm.samples.tuned import TunedNetwork, save_network
from qsgm.task import TaskRecord
from qsgm.tune.plan import resolve
from qsgm.tune.prepare import prepare
from qsgm.tune.result import Result
from qsgm.tune.run import tune
from qsgm.tune.settings import Settings


@dataclass(frozen=True)
class SamplesResult(Result):
    """A tuned network and everything that was measured on the way."""

    def save(self, folder: Path, name: str) -> None:
        """Write the tuned network for `qsgm predict`; it appears complete or not at all.

        Raises:
            QsgmError: the folder cannot be written, or holds something else.
        """
        report = run_json(self, name, folder)
        save_network(folder, self.record, self.network(), name, self._made(), report)

    @property
    def record(self) -> TaskRecord:
        """What it is for."""
        return self.prepared.bundle.manifest.task

    def tuned_network(self, name: str = "network") -> TunedNetwork:
        """The tuned network without a detour over the disk."""
        return TunedNetwork(name, self.record, self.network(), self.plan.settings.threads)

    def _made(self) -> dict[str, Any]:
        """By what: with the same of all this and the same samples the same network comes out."""
        return {
            "qsgm": __version__,
            "onnxruntime": ort.__version__,
            "numpy": np.__version__,
            "bundle_sha256": self.prepared.bundle.sha256(),
            "seed": self.plan.settings.seed,
        }


def learn(
    shown: Samples | Sequence[Samples],
    bundle: Bundle,
    task: SampleTask | None = None,
    settings: Settings | None = None,
    watch: Progress | None = None,
) -> SamplesResult:
    """Tune a bundle's network to samples; a part of them is held out and says what it is worth.

    Args:
        shown: labelled samples.
        bundle: whose network is tuned.
        task: the bundle's; None: `arrays`, which is built in.
        settings: how; None: :func:`usual_settings`.
        watch: told about progress.

    Raises:
        QsgmError: samples, task or settings do not fit the bundle, or training diverged.
    """
    task = task_of_bundle(bundle, task)
    some = [shown] if isinstance(shown, Samples) else [*shown]
    checked = [checked_samples(one, task.network, task.heads, "the samples") for one in some]
    plan = resolve(settings or usual_settings(bundle, task), bundle)
    lesson = task.lesson(checked, np.random.default_rng(plan.settings.seed))
    result = tune(prepare(lesson, bundle, plan, watch), plan, watch)
    worse = fallen(task.heads, result.untouched, result.scores)
    result = replace(result, warnings=(*result.warnings, *worse))
    return SamplesResult(**{one.name: getattr(result, one.name) for one in fields(result)})


def usual_settings(bundle: Bundle, task: SampleTask) -> Settings:
    """In float, as many layers as the task says and the bundle can do, epochs as for samples."""
    layers = min(task.tuned, bundle.manifest.most_layers)
    return Settings(layers=layers, epochs=defaults.SAMPLE_EPOCHS)
