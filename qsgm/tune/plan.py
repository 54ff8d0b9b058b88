"""A run's settings with every question answered, once."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from numpy.typing import NDArray

from qsgm import defaults
from qsgm.blocks import Blocks, one_block, parse_blocks, single_layers
from qsgm.bundle import Bundle
from qsgm.errors import QsgmError
from qsgm.manifest import Method, Precision, Recipe, head_file, probe_file, step_file, trunk_file
from qsgm.tune.settings import Settings

# Constants of int8 SGMs in the place of the bundle's: by layer, by initializer name.
Overrides = Mapping[int, Mapping[str, NDArray[Any]]]
NO_OVERRIDES: Overrides = MappingProxyType({})


@dataclass(frozen=True)
class Plan:
    """One run of one method by one bundle's graphs."""

    settings: Settings
    blocks: Blocks  # what is trained, block by block
    sgm_blocks: Blocks  # whose SGMs are looked at: for backpropagation those it is compared with
    precision: Precision  # of SGMs; float where there are none
    trunk: Precision  # of the frozen layers
    recipe: Recipe
    overrides: Overrides = field(default_factory=lambda: NO_OVERRIDES)

    @property
    def layers(self) -> range:
        """Numbers of the tuned layers."""
        return self.blocks.layers

    @property
    def epochs(self) -> int:
        """Passes over the samples."""
        return self.settings.epochs

    @property
    def step_file(self) -> str:
        """Name of the training step's graph."""
        return step_file(self.precision, self.recipe.optimizer, self.blocks)

    @property
    def trunk_file(self) -> str:
        """Name of the frozen layers' graph."""
        return trunk_file(self.trunk, self.layers)

    @property
    def head_file(self) -> str:
        """Name of the tuned layers' graph."""
        return head_file(len(self.layers))

    @property
    def probe_file(self) -> str:
        """Name of the graph that compares gradients."""
        return probe_file(len(self.layers))

    @property
    def takes_much_memory(self) -> bool:
        """Whether layers with large maps are tuned, whose activations are most of a run's memory.

        Then none is held longer than needed. With fewer layers there is nothing to gain: beside the
        libraries the activations are small.
        """
        return len(self.layers) > defaults.LAYERS


def resolve(settings: Settings, bundle: Bundle, recipe: Recipe | None = None) -> Plan:
    """Answer every question that settings leave open.

    Args:
        settings: of a run.
        bundle: whose graphs it runs.
        recipe: optimizer and rates; None: the bundle's for these settings.

    Raises:
        QsgmError: the settings contradict each other, or the bundle cannot do what they ask for.
    """
    layers = bundle.network.last(settings.layers)
    with_sgms = _sgm_blocks(settings, layers, bundle)
    blocks = _trained_blocks(settings, with_sgms)
    bundle.check_blocks(blocks)
    return Plan(
        settings,
        blocks,
        with_sgms,
        "float" if settings.method == "bp" else settings.precision,
        settings.trunk or bundle.manifest.trunk,
        recipe or bundle.recipe(settings.method, layers, settings.optimizer, blocks),
    )


def peak_activation_bytes(
    bundle: Bundle, precision: Precision, blocks: Blocks
) -> dict[str, int | None]:
    """Bytes of activations alive at once in a step of 32 samples, with SGMs and by backpropagation.

    Reckoned from the graphs when they were exported: weights, states, inputs and outputs do not
    count. None: the bundle does not say.
    """
    recipes, whole = bundle.manifest.recipes, one_block(blocks.layers)
    names = {
        "sgm": step_file(precision, recipes["sgm"].usual(str(blocks)), blocks),
        "backprop": step_file("float", recipes["bp"].usual(str(whole)), whole),
    }
    return {method: bundle.peak_activation_bytes(name) for method, name in names.items()}


def _sgm_blocks(settings: Settings, layers: range, bundle: Bundle) -> Blocks:
    """The blocks of a run with SGMs; groups are trained with SGD only."""
    usual = bundle.manifest.usual_blocks.get(len(layers))
    if settings.blocks is None:
        alone = usual is None or settings.optimizer == "adam"
        return single_layers(layers) if alone else parse_blocks(str(usual), layers[-1])
    blocks = parse_blocks(settings.blocks, layers[-1])
    if len(blocks.layers) != settings.layers:
        raise QsgmError(
            f"the blocks {blocks} are the last {len(blocks.layers)} layers, the settings say "
            f"{settings.layers}: give both the same"
        )
    return blocks


def _trained_blocks(settings: Settings, blocks: Blocks) -> Blocks:
    """The blocks that are really trained, from those of a run with SGMs."""
    method: Method = settings.method
    whole = one_block(blocks.layers)
    if method == "sgm":
        if blocks == whole and settings.layers > 1:
            raise QsgmError(f"the blocks {blocks} leave no place for an SGM: pass --method bp")
        return blocks
    if settings.blocks is not None and blocks != whole:
        raise QsgmError(
            f"backpropagation trains all layers as one block, {whole}, not as {blocks}: leave "
            "--blocks out, or --method bp"
        )
    return whole
