"""A training step without loops, for runtimes that have no Scan: all crops at once.

The body of such a loop takes one crop's rows and adds what it finds to sums. It counts no crops, so
that it may as well take the rows of all of them: the sums are the same, but for the order in which
they are added up, and every crop's windows are in memory together.
"""

import numpy as np
from onnx import GraphProto, ModelProto, NodeProto, ValueInfoProto, helper, numpy_helper

from qsgm.train.graphs.inspection import bodies


def has_loops(model: ModelProto) -> bool:
    """Whether any node runs a graph of its own."""
    return any(bodies(node) for node in model.graph.node)


def without_loops(model: ModelProto) -> None:
    """Put the body of every loop over crops in the loop's place; the model is changed."""
    graph = model.graph
    nodes = [inner for node in graph.node for inner in _at_once(graph, node)]
    del graph.node[:]
    graph.node.extend(nodes)


def _at_once(graph: GraphProto, node: NodeProto) -> list[NodeProto]:
    """A loop's nodes, all items taken for one; of another node itself."""
    if not bodies(node):
        return [node]
    (body,) = bodies(node)
    sums = len(node.input) - next(one.i for one in node.attribute if one.name == "num_scan_inputs")
    names = {
        inside.name: outside
        for insides, outsides in ((body.input, node.input), (body.output, node.output))
        for inside, outside in zip(insides[:sums], outsides[:sums], strict=True)
    }
    for inner in body.node:
        inner.input[:] = [names.get(value, value) for value in inner.input]
        inner.output[:] = [names.get(value, value) for value in inner.output]
    items = zip(node.input[sums:], body.input[sums:], strict=True)
    stacks = zip(body.output[sums:], node.output[sums:], strict=True)
    return [
        *(_rows(graph, outside, one.name, _shape(one)[1:]) for outside, one in items),
        *body.node,
        *(_rows(graph, one.name, outside, _shape(one)) for one, outside in stacks),
    ]


def _shape(value: ValueInfoProto) -> list[int]:
    return [side.dim_value for side in value.type.tensor_type.shape.dim]


def _rows(graph: GraphProto, source: str, target: str, shape: list[int]) -> NodeProto:
    """A node that makes `target` of `source`: as many rows as there are, each of this shape."""
    sizes = numpy_helper.from_array(np.array([-1, *shape], np.int64), f"{target}/shape")
    graph.initializer.append(sizes)
    return helper.make_node("Reshape", [source, sizes.name], [target], name=target)
