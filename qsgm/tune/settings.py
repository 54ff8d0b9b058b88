"""How to tune, as a user says it: what the command line and the benchmarks hand to a run."""

from dataclasses import dataclass

from qsgm import defaults
from qsgm.manifest import Method, OptimizerName, Precision


@dataclass(frozen=True)
class Settings:
    """How to tune; what is None is up to the bundle."""

    method: Method = "sgm"
    precision: Precision = defaults.PRECISION  # of the SGMs; backpropagation has one, float
    layers: int = defaults.LAYERS  # how many of the last ones
    blocks: str | None = None  # those layers in groups, such as 4,5-6; None: each on its own
    trunk: Precision | None = None  # of the frozen layers
    optimizer: OptimizerName | None = None
    epochs: int = defaults.EPOCHS
    recalibrate: bool = False  # int8 SGMs, which it takes, on these samples before any step
    stream: bool = False  # make samples and features again for every batch, keep none
    seed: int = 0
    threads: int = 1
    probe_every: int = defaults.PROBE_EVERY  # steps from one look at the gradients to the next
