"""Write an ONNX graph operator by operator.

    graph = Graph("double")
    op = graph.within("layer4")
    x = graph.input("x", np.float32, ("batch", 3))
    graph.output("twice", op.Mul(x, op.constant(2.0)), np.float32, ("batch", 3))
    model = graph.model()

A value is known by its name, a plain string. Opset and IR version are old enough for every
runtime since 2023, and the default domain is the only one.

The body of a loop is a graph in another one. It sees that one's inputs, and keeps its constants
there.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import onnx
from numpy.typing import ArrayLike, DTypeLike, NDArray
from onnx import helper, numpy_helper

# The oldest in which onnx's reference evaluator dequantizes.
OPSET = 19
IR_VERSION = 9

Value = str
Dimension = int | str  # a number, or the name of a size that is free


class Operator(Protocol):
    """Adds one node and names its only output."""

    def __call__(self, *inputs: Value, **attributes: Any) -> Value: ...


class Graph:
    """Inputs, outputs, constants and nodes, in the order they were added."""

    def __init__(self, name: str, around: "Graph | None" = None) -> None:
        self.name = name
        self.around = around  # the graph in which this one is the body of a loop
        self.nodes: list[onnx.NodeProto] = []
        self.inputs: list[onnx.ValueInfoProto] = []
        self.outputs: list[onnx.ValueInfoProto] = []
        self.output_names: dict[Value, str] = {}
        self.constants: dict[str, onnx.TensorProto] = {}
        self._shared: dict[tuple[str, tuple[int, ...], bytes], Value] = {}

    def within(self, scope: str) -> "Ops":
        """Operators whose nodes and values carry `scope` in their names."""
        return Ops(self, scope)

    def input(self, name: str, dtype: DTypeLike, shape: Sequence[Dimension]) -> Value:
        """Declare an input of the graph."""
        self.inputs.append(_value_info(name, dtype, shape))
        return name

    def output(self, name: str, value: Value, dtype: DTypeLike, shape: Sequence[Dimension]) -> None:
        """Declare that `value`, the result of a node, is the graph's output `name`."""
        assert value not in self.output_names, f"{value} is an output already"
        self.output_names[value] = name
        self.outputs.append(_value_info(name, dtype, shape))

    def initializer(self, name: str, array: NDArray[Any]) -> Value:
        """A constant under a name of its own, its bytes in raw_data."""
        if self.around is not None:
            return self.around.initializer(name, array)
        self.constants[name] = numpy_helper.from_array(np.array(array, order="C"), name)
        return name

    def constant(self, value: ArrayLike, dtype: DTypeLike = np.float32) -> Value:
        """A constant without a name of its own; equal ones are stored once."""
        if self.around is not None:
            return self.around.constant(value, dtype)
        array = np.asarray(value, dtype=dtype)
        key = str(array.dtype), array.shape, array.tobytes()
        if key not in self._shared:
            name = f"constant_{len(self._shared)}"
            self._shared[key] = self.initializer(name, array)
        return self._shared[key]

    def finished(self) -> onnx.GraphProto:
        """What was added so far."""
        constants = list(self.constants.values())
        return helper.make_graph(
            self._listed_nodes(), self.name, self.inputs, self.outputs, constants
        )

    def model(self) -> onnx.ModelProto:
        """The finished model, checked, with strict shape inference."""
        model = helper.make_model(
            self.finished(),
            producer_name="qsgm",
            ir_version=IR_VERSION,
            opset_imports=[helper.make_opsetid("", OPSET)],
        )
        onnx.checker.check_model(model, full_check=True)
        return model

    def _listed_nodes(self) -> list[onnx.NodeProto]:
        """The nodes with the outputs' names, listed so that they run in the order written.

        ONNX Runtime starts from the nodes that nothing consumes, the last one listed first, and
        before each runs what it needs. Listed as written, the last layer's update would come
        first and every layer's windows would stay in memory until then.
        """
        nodes = []
        for node in self.nodes:
            renamed = onnx.NodeProto()
            renamed.CopyFrom(node)
            renamed.input[:] = [self.output_names.get(value, value) for value in node.input]
            renamed.output[:] = [self.output_names.get(value, value) for value in node.output]
            nodes.append(renamed)
        consumed = {value for node in nodes for value in read_by(node)}
        last = [node for node in nodes if consumed.isdisjoint(node.output)]
        return [node for node in nodes if not consumed.isdisjoint(node.output)] + last[::-1]


def read_by(node: onnx.NodeProto) -> Iterator[Value]:
    """Inputs of a node and, of a loop, all that its body reads."""
    yield from node.input
    for attribute in node.attribute:
        for inner in attribute.g.node:
            yield from read_by(inner)


class Ops:
    """Every ONNX operator as a method: `op.Gemm(x, w, b, transB=1)` adds a node."""

    def __init__(self, graph: Graph, scope: str) -> None:
        self.graph = graph
        self.scope = scope

    def __getattr__(self, op_type: str) -> Operator:
        if not op_type[0].isupper():
            raise AttributeError(op_type)

        def add(*inputs: Value, **attributes: Any) -> Value:
            graph = self.graph
            scope = self.scope if graph.around is None else f"{self.scope}/{graph.name}"
            result = f"{scope}/{len(graph.nodes)}"
            node = helper.make_node(op_type, inputs, [result], name=result, **attributes)
            graph.nodes.append(node)
            return result

        return add

    def one_by_one(
        self, body: Graph, sums: Sequence[Value], items: Sequence[Value]
    ) -> tuple[list[Value], list[Value]]:
        """Run `body` on item after item of the first axis of all `items` (ONNX's Scan).

        Args:
            body: its inputs are the sums so far, then an item of each; its outputs are the sums
                after it, then whatever it makes of the items.
            sums: what they start from.
            items: of the same length.

        Returns:
            The sums after the last item, and the other outputs, stacked along a new first axis.
        """
        node = helper.make_node(
            "Scan",
            [*sums, *items],
            [f"{self.scope}/{output.name}" for output in body.outputs],
            name=f"{self.scope}/{body.name}",
            body=body.finished(),
            num_scan_inputs=len(items),
        )
        self.graph.nodes.append(node)
        return list(node.output[: len(sums)]), list(node.output[len(sums) :])

    def outside(self) -> "Ops":
        """Operators of the graph around all loops."""
        graph = self.graph
        while graph.around is not None:
            graph = graph.around
        return graph.within(self.scope)

    def constant(self, value: ArrayLike, dtype: DTypeLike = np.float32) -> Value:
        """See :meth:`Graph.constant`."""
        return self.graph.constant(value, dtype)

    def shape(self, *sizes: int) -> Value:
        """A shape for Reshape and its like; -1: whatever is left, 0: as it was."""
        return self.graph.constant(sizes, np.int64)


@dataclass(frozen=True)
class Product:
    """A matrix product that is not in the graph yet: what is added to it costs no node."""

    left: Value
    right: Value
    turned: bool = False  # whether the left one is to be transposed

    def alone(self, op: Ops) -> Value:
        return op.Gemm(self.left, self.right, transA=int(self.turned))

    def plus(self, op: Ops, value: Value, factor: float) -> Value:
        """The product plus `factor` times a value of its shape."""
        return op.Gemm(self.left, self.right, value, transA=int(self.turned), beta=factor)


def _value_info(name: str, dtype: DTypeLike, shape: Sequence[Dimension]) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(
        name, helper.np_dtype_to_tensor_dtype(np.dtype(dtype)), shape
    )
