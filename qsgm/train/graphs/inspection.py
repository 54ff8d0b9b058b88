"""Which operators ONNX Runtime makes of a graph.

A wrong pattern runs all the same, in float and slowly: look before shipping.
"""

import tempfile
from pathlib import Path

import onnx
import onnxruntime as ort

INTEGER_OPERATORS = frozenset({"QGemm", "QLinearConv", "QLinearMatMul", "MatMulIntegerToFloat"})


def optimized_nodes(model: onnx.ModelProto) -> list[onnx.NodeProto]:
    """The nodes that ONNX Runtime runs, after its hardware-independent optimizations."""
    options = ort.SessionOptions()
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_EXTENDED
    with tempfile.TemporaryDirectory() as folder:
        options.optimized_model_filepath = str(Path(folder) / "optimized.onnx")
        ort.InferenceSession(model.SerializeToString(), options, ["CPUExecutionProvider"])
        return list(onnx.load(options.optimized_model_filepath).graph.node)


def integer_operators(model: onnx.ModelProto) -> list[str]:
    """Type of every operator that computes products in integers, one entry per node."""
    return [node.op_type for node in optimized_nodes(model) if node.op_type in INTEGER_OPERATORS]
