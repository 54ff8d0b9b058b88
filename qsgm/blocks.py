"""Blocks: the tuned layers in groups of neighbours, each trained on its own.

Inside a block true gradients are carried back through its layers. The gradient on its output comes
from the SGM behind it; that on the last block's output from the loss. As text: `4,5,6` is every
layer on its own, as in the paper; in `1-4,5,6` SGMs stand behind layers 4 and 5 alone; `4-6` is
one block without any SGM, which is backpropagation.
"""

import re
from dataclasses import dataclass

from qsgm.errors import QsgmError

LAYERS = 6
_GROUP = re.compile(r"([1-9])(?:-([1-9]))?")


@dataclass(frozen=True)
class Blocks:
    """The last layers in groups; `str` gives them as text, such as `1-4,5,6`."""

    groups: tuple[range, ...]  # numbers of neighbouring layers; the last group ends with layer 6

    def __str__(self) -> str:
        return ",".join(f"{g[0]}" if len(g) == 1 else f"{g[0]}-{g[-1]}" for g in self.groups)

    @property
    def layers(self) -> range:
        """Numbers of all tuned layers."""
        return range(self.groups[0][0], LAYERS + 1)

    @property
    def sgm_layers(self) -> tuple[int, ...]:
        """Layers with an SGM behind them: the last of every block but the last."""
        return tuple(group[-1] for group in self.groups[:-1])


def tuned_layers(tuned: int) -> range:
    """Numbers of the last `tuned` layers. Raises QsgmError unless there are as many."""
    if not 1 <= tuned <= LAYERS:
        raise QsgmError(f"cannot tune the last {tuned} layers: choose 1 to {LAYERS}")
    return range(LAYERS + 1 - tuned, LAYERS + 1)


def single_layers(tuned: int) -> Blocks:
    """Each of the last `tuned` layers a block."""
    return Blocks(tuple(range(number, number + 1) for number in tuned_layers(tuned)))


def one_block(tuned: int) -> Blocks:
    """The last `tuned` layers as one block: backpropagation."""
    return Blocks((tuned_layers(tuned),))


def parse_blocks(text: str) -> Blocks:
    """Blocks from their text.

    Raises:
        QsgmError: unless it names every layer from its first to layer 6 once and in order, and
            each group the short way, `5` rather than `5-5`.
    """
    blocks = Blocks(tuple(map(_group, text.split(","))))
    numbers = [number for group in blocks.groups for number in group]
    whole = all(blocks.groups) and numbers == [*range(numbers[0], LAYERS + 1)]
    if not whole or str(blocks) != text:
        raise QsgmError(
            f"{text[:40]!r} gives no blocks of layers: expected every layer from the first tuned"
            f" one to layer {LAYERS}, alone or in ranges, such as 4,5,6 or 1-4,5,6"
        )
    return blocks


def _group(text: str) -> range:
    """One block's layers; none where the text does not say."""
    found = _GROUP.fullmatch(text)
    return range(int(found[1]), int(found[2] or found[1]) + 1) if found else range(0)
