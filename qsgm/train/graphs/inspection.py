"""Which operators ONNX Runtime makes of a graph.

A wrong pattern runs all the same, in float and slowly: look before shipping.
"""

import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import onnx
import onnxruntime as ort

from qsgm.errors import QsgmError
from qsgm.runtime import session_options

PRODUCTS = frozenset({"Gemm", "MatMul", "Conv"})
INTEGER_OPERATORS = frozenset({"QGemm", "QLinearConv", "QLinearMatMul", "MatMulIntegerToFloat"})


def optimized_nodes(model: onnx.ModelProto) -> list[onnx.NodeProto]:
    """The nodes that ONNX Runtime runs, after its hardware-independent optimizations."""
    options = session_options()
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_EXTENDED
    with tempfile.TemporaryDirectory() as folder:
        options.optimized_model_filepath = str(Path(folder) / "optimized.onnx")
        ort.InferenceSession(model.SerializeToString(), options, ["CPUExecutionProvider"])
        return list(all_nodes(onnx.load(options.optimized_model_filepath).graph))


def all_nodes(graph: onnx.GraphProto) -> Iterator[onnx.NodeProto]:
    """A graph's nodes; in front of a loop, those of its body."""
    for node in graph.node:
        for body in bodies(node):
            yield from all_nodes(body)
        yield node


def bodies(node: onnx.NodeProto) -> list[onnx.GraphProto]:
    """The graph that a loop runs again and again; of other nodes none."""
    return [one.g for one in node.attribute if one.type == onnx.AttributeProto.GRAPH]


def integer_operators(model: onnx.ModelProto) -> list[str]:
    """Type of every operator that computes products in integers, one entry per node."""
    return [node.op_type for node in optimized_nodes(model) if node.op_type in INTEGER_OPERATORS]


def refuse_float_products(name: str, model: onnx.ModelProto) -> None:
    """Raise QsgmError unless every product of rounded inputs is computed in integers.

    `name` is the graph's, for the message.
    """
    written = by_layer(products_of_rounded([*all_nodes(model.graph)]), PRODUCTS)
    integer = by_layer(optimized_nodes(model), INTEGER_OPERATORS)
    for layer, expected in sorted(written.items()):
        if integer[layer] != expected:
            raise QsgmError(
                f"{name}: ONNX Runtime {ort.__version__} computes {integer[layer]} of the"
                f" {expected} int8 products of {layer} in integers; install another version"
            )


def products_of_rounded(nodes: Sequence[onnx.NodeProto]) -> list[onnx.NodeProto]:
    """The products whose first factor was rounded."""
    rounded = {node.output[0] for node in nodes if node.op_type == "DequantizeLinear"}
    return [node for node in nodes if node.op_type in PRODUCTS and node.input[0] in rounded]


def by_layer(nodes: Iterable[onnx.NodeProto], op_types: frozenset[str]) -> Counter[str]:
    """How many nodes of these types each layer has: the first part of a node's name."""
    return Counter(node.name.partition("/")[0] for node in nodes if node.op_type in op_types)
