"""Names as short as they can be, for a bundle that has to be small.

What a device knows by name stays: inputs, outputs and the constants that it exchanges.
"""

from collections.abc import Iterator
from itertools import count, product
from string import ascii_letters

import onnx

from qsgm.train.graphs.inspection import bodies
from qsgm.train.graphs.sharing import EXCHANGED


def shorten(model: onnx.ModelProto) -> None:
    """Rename all other values, and nodes by what they make; the model is changed."""
    graph = model.graph
    kept = {value.name for value in (*graph.input, *graph.output)}
    kept |= {one.name for one in graph.initializer if one.name.startswith(EXCHANGED)}
    fresh = (name for name in short_names() if name not in kept)
    names = {"": "", **{name: name for name in kept}}

    for value in values_of(graph):
        if value not in names:
            names[value] = next(fresh)
    rename(graph, names)


def short_names() -> Iterator[str]:
    """a, b, and so on; aa, ab, and so on."""
    for length in count(1):
        yield from map("".join, product(ascii_letters, repeat=length))


def values_of(graph: onnx.GraphProto) -> Iterator[str]:
    """Every value of a graph and of the loops in it."""
    yield from (one.name for one in (*graph.initializer, *graph.input))
    for node in graph.node:
        for body in bodies(node):
            yield from values_of(body)
        yield from node.output


def rename(graph: onnx.GraphProto, names: dict[str, str]) -> None:
    """Give every value of a graph and of the loops in it its new name, and nodes their first's."""
    graph.name = "g"
    for value in (*graph.input, *graph.output, *graph.initializer):
        value.name = names[value.name]
    for node in graph.node:
        node.input[:] = [names[value] for value in node.input]
        node.output[:] = [names[value] for value in node.output]
        node.name = node.output[0]
        for body in bodies(node):
            rename(body, names)
