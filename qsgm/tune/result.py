"""What a run comes to."""

from dataclasses import dataclass

from qsgm.blocks import Blocks
from qsgm.fidelity import LayerFidelity, mean_over_run
from qsgm.schedule import steps_per_epoch
from qsgm.task import Array, Scores
from qsgm.tune.plan import Plan, peak_activation_bytes
from qsgm.tune.prepare import Prepared
from qsgm.tune.probe import Probe


@dataclass(frozen=True)
class Result:
    """Tuned weights and everything that was measured on the way."""

    prepared: Prepared
    plan: Plan
    weights: dict[str, Array]  # (Co, Ci, kh, kw) and biases (Co,)
    scores: Scores  # on the held-out samples
    losses: tuple[float, ...]  # mean over each epoch
    # crops, features, tuning, probes, total; what is streamed counts where it is asked for
    seconds: dict[str, float]
    probes: tuple[Probe, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def steps(self) -> int:
        """How many there were."""
        return self.plan.epochs * steps_per_epoch(self.prepared.taught)

    @property
    def untouched(self) -> Scores:
        """Scores of the network before any step, on the held-out samples."""
        return self.prepared.untouched

    @property
    def blocks(self) -> Blocks:
        """What was trained, block by block."""
        return self.plan.blocks

    @property
    def fidelity(self) -> dict[int, LayerFidelity]:
        """By SGM layer, the mean over the run."""
        if not self.probes:
            return {}
        layers = self.probes[0].layers
        return {k: mean_over_run([probe.layers[k] for probe in self.probes]) for k in layers}

    @property
    def peak_activation_bytes(self) -> dict[str, int | None]:
        """Bytes of activations alive in a step, with SGMs and by backpropagation."""
        precision = self.plan.settings.precision
        return peak_activation_bytes(self.prepared.bundle, precision, self.plan.sgm_blocks)

    def network(self) -> bytes:
        """The tuned network as an ONNX file."""
        return self.prepared.bundle.network_with(self.weights)
