"""How to tune: what the command line and the benchmarks hand to a run."""

from dataclasses import dataclass

from qsgm import defaults
from qsgm.blocks import Blocks, one_block, parse_blocks, single_layers
from qsgm.bundle import Bundle, Method, OptimizerName, Precision
from qsgm.errors import QsgmError


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
    recalibrate: bool = False  # int8 SGMs, which it takes, on this object's crops before any step
    stream: bool = False  # make crops and features again for every batch, keep none
    seed: int = 0
    center_px: tuple[float, float] | None = None  # of the object; None: the frame's centre
    span_px: float | None = None  # long side of the object in the first frame; None: measured
    threads: int = 1
    probe_every: int = defaults.PROBE_EVERY  # steps from one look at the gradients to the next


def takes_much_memory(settings: Settings) -> bool:
    """Whether layers with large maps are tuned, whose activations are most of a run's memory.

    Then none is held longer than needed. With fewer layers there is nothing to gain: beside the
    libraries the activations are small.
    """
    return settings.layers > defaults.LAYERS


def sgm_blocks(settings: Settings) -> Blocks:
    """The blocks of a run with SGMs: what its steps are, or what backpropagation is compared with.

    Raises:
        QsgmError: the settings' blocks are none, or those of another number of layers.
    """
    if settings.blocks is None:
        return single_layers(settings.layers)
    blocks = parse_blocks(settings.blocks)
    if len(blocks.layers) != settings.layers:
        raise QsgmError(
            f"the blocks {blocks} are the last {len(blocks.layers)} layers, the settings say "
            f"{settings.layers}: give both the same"
        )
    return blocks


def run_blocks(settings: Settings) -> Blocks:
    """The blocks that are really trained.

    Raises:
        QsgmError: as :func:`sgm_blocks`, or the blocks do not go with the method.
    """
    blocks, whole = sgm_blocks(settings), one_block(settings.layers)
    if settings.method == "sgm":
        if blocks == whole and settings.layers > 1:
            raise QsgmError(f"the blocks {blocks} leave no place for an SGM: pass --method bp")
        return blocks
    if settings.blocks is not None and blocks != whole:
        raise QsgmError(
            f"backpropagation trains all layers as one block, {whole}, not as {blocks}: leave "
            "--blocks out, or --method bp"
        )
    return whole


def trunk_precision(settings: Settings, bundle: Bundle) -> Precision:
    """Of the frozen layers: the settings' or, where they have none, the bundle's."""
    return settings.trunk or bundle.trunk
