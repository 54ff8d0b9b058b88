"""Blocks: the tuned layers in groups of neighbours, each trained on its own.

Inside a block true gradients are carried back through its layers. The gradient on its output comes
from the SGM behind it; that on the last block's output from the loss. As text, of six layers:
`4,5,6` is every layer on its own, as in the paper; in `1-4,5,6` SGMs stand behind layers 4 and 5
alone; `4-6` is one block without any SGM, which is backpropagation.
"""

import re
from dataclasses import dataclass

from qsgm.errors import QsgmError

_GROUP = re.compile(r"([1-9]\d?)(?:-([1-9]\d?))?")


@dataclass(frozen=True)
class Blocks:
    """The last layers in groups; `str` gives them as text, such as `1-4,5,6`."""

    groups: tuple[range, ...]  # numbers of neighbouring layers

    def __str__(self) -> str:
        return ",".join(f"{g[0]}" if len(g) == 1 else f"{g[0]}-{g[-1]}" for g in self.groups)

    @property
    def layers(self) -> range:
        """Numbers of all tuned layers."""
        return range(self.groups[0][0], self.groups[-1][-1] + 1)

    @property
    def sgm_layers(self) -> tuple[int, ...]:
        """Layers with an SGM behind them: the last of every block but the last."""
        return tuple(group[-1] for group in self.groups[:-1])


def single_layers(layers: range) -> Blocks:
    """Each of these layers a block."""
    return Blocks(tuple(range(number, number + 1) for number in layers))


def one_block(layers: range) -> Blocks:
    """All layers in one block, which is backpropagation."""
    return Blocks((layers,))


def parse_blocks(text: str, depth: int | None = None) -> Blocks:
    """Blocks from their text.

    Args:
        text: such as `1-4,5,6`.
        depth: of the network, where it is known: its last layer has to be the text's.

    Raises:
        QsgmError: unless it names every layer from its first to its last once and in order, and
            each group the short way, `5` rather than `5-5`.
    """
    blocks = Blocks(tuple(map(_group, text.split(","))))
    numbers = [number for group in blocks.groups for number in group]
    whole = all(blocks.groups) and numbers == [*blocks.layers] and depth in (None, numbers[-1])
    if not whole or str(blocks) != text:
        last = "the last one" if depth is None else f"layer {depth}"
        raise QsgmError(
            f"{text[:40]!r} gives no blocks of layers: expected every layer from the first tuned"
            f" one to {last}, alone or in ranges, such as 4,5,6 or 1-4,5,6"
        )
    return blocks


def _group(text: str) -> range:
    """One block's layers; none where the text does not say."""
    found = _GROUP.fullmatch(text)
    return range(int(found[1]), int(found[2] or found[1]) + 1) if found else range(0)
