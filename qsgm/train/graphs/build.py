"""Write an ONNX graph operator by operator.

    graph = Graph("double")
    op = graph.within("layer4")
    x = graph.input("x", np.float32, ("batch", 3))
    graph.output("twice", op.Mul(x, op.constant(2.0)), np.float32, ("batch", 3))
    model = graph.model()

A value is known by its name, a plain string. Opset and IR version are old enough for every
runtime since 2022, and the default domain is the only one.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import onnx
from numpy.typing import ArrayLike, DTypeLike, NDArray
from onnx import helper, numpy_helper

OPSET = 17
IR_VERSION = 8

Value = str
Dimension = int | str  # a number, or the name of a size that is free


class Operator(Protocol):
    """Adds one node and names its only output."""

    def __call__(self, *inputs: Value, **attributes: Any) -> Value: ...


class Graph:
    """Inputs, outputs, constants and nodes, in the order they were added."""

    def __init__(self, name: str) -> None:
        self.name = name
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
        self.constants[name] = numpy_helper.from_array(np.array(array, order="C"), name)
        return name

    def constant(self, value: ArrayLike, dtype: DTypeLike = np.float32) -> Value:
        """A constant without a name of its own; equal ones are stored once."""
        array = np.asarray(value, dtype=dtype)
        key = str(array.dtype), array.shape, array.tobytes()
        if key not in self._shared:
            name = f"constant_{len(self._shared)}"
            self._shared[key] = self.initializer(name, array)
        return self._shared[key]

    def model(self) -> onnx.ModelProto:
        """The finished model, checked, with strict shape inference."""
        graph = helper.make_graph(
            self._listed_nodes(),
            self.name,
            self.inputs,
            self.outputs,
            list(self.constants.values()),
        )
        model = helper.make_model(
            graph,
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
        consumed = {value for node in nodes for value in node.input}
        last = [node for node in nodes if node.output[0] not in consumed]
        return [node for node in nodes if node.output[0] in consumed] + last[::-1]


class Ops:
    """Every ONNX operator as a method: `op.Gemm(x, w, b, transB=1)` adds a node."""

    def __init__(self, graph: Graph, scope: str) -> None:
        self.graph = graph
        self.scope = scope

    def __getattr__(self, op_type: str) -> Operator:
        if not op_type[0].isupper():
            raise AttributeError(op_type)

        def add(*inputs: Value, **attributes: Any) -> Value:
            result = f"{self.scope}/{op_type}_{len(self.graph.nodes)}"
            node = helper.make_node(op_type, inputs, [result], name=result, **attributes)
            self.graph.nodes.append(node)
            return result

        return add

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
