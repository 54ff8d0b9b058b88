"""Sessions: exact integer products on every CPU, and graphs that do not fit are refused."""

import numpy as np
import onnx
import pytest
from onnx import helper

from qsgm import QsgmError
from qsgm.blocks import single_layers
from qsgm.bundle import Bundle
from qsgm.manifest import probe_file, step_file, trunk_file
from qsgm.runtime import open_session, run_options, running
from qsgm.sgm.int8 import U8_ZERO, around_zero_point
from qsgm.train.graphs.inspection import integer_operators


@pytest.mark.parametrize(
    "name",
    [
        trunk_file("int8", 3),
        probe_file(3),
        step_file("int8", "sgd", single_layers(3)),
        step_file("int8", "sgd", single_layers(6)),
    ],
)
def test_no_graph_multiplies_by_s8_which_saturates_on_cpus_without_vnni(
    bundle: Bundle, name: str
) -> None:
    graph = onnx.load(bundle.folder / name).graph
    kinds = {tensor.data_type for tensor in graph.initializer}
    assert onnx.TensorProto.UINT8 in kinds
    assert onnx.TensorProto.INT8 not in kinds


def test_weights_around_their_zero_point_are_exact_where_pairs_exceed_16_bits() -> None:
    weight = np.tile(np.array([127, -128, 127, 127], np.int8), (4, 2)).T  # (8, 4)
    node = helper.make_node("MatMulInteger", ["x", "weight", "", "zero"], ["y"])
    x_info = helper.make_tensor_value_info("x", onnx.TensorProto.UINT8, ["rows", 8])
    y_info = helper.make_tensor_value_info("y", onnx.TensorProto.INT32, ["rows", 4])
    constants = [
        onnx.numpy_helper.from_array(around_zero_point(weight), "weight"),
        onnx.numpy_helper.from_array(np.array(U8_ZERO, np.uint8), "zero"),
    ]
    graph = helper.make_graph([node], "product", [x_info], [y_info], constants)
    opsets = [helper.make_opsetid("", 17)]
    model = helper.make_model(graph, opset_imports=opsets, ir_version=9)
    x = np.full((3, 8), 255, np.uint8)
    (product,) = open_session(model.SerializeToString()).run(None, {"x": x})
    np.testing.assert_array_equal(product, x.astype(int) @ weight.astype(int))


def test_int8_sgms_run_as_integer_products_with_these_settings(bundle: Bundle) -> None:
    model = onnx.load(bundle.folder / step_file("int8", "sgd", single_layers(3)))
    assert set(integer_operators(model)) == {"QGemm"}


def test_a_run_that_gives_its_memory_back_gives_the_same(bundle: Bundle) -> None:
    session = bundle.session(trunk_file("float", 3))
    feeds = {"crops": np.random.default_rng(0).integers(0, 256, (2, 128, 128, 3), np.uint8)}
    options = run_options(give_memory_back=True)
    assert options.get_run_config_entry("memory.enable_memory_arena_shrinkage") == "cpu:0"
    plain, frugal, again = (session.run(None, feeds, some)[0] for some in (None, options, None))
    np.testing.assert_array_equal(frugal, plain)
    np.testing.assert_array_equal(again, plain)


def test_what_is_no_graph_is_refused_in_one_line() -> None:
    with pytest.raises(QsgmError, match="cannot load a graph") as raised:
        open_session(b"not a graph")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "feeds",
    [
        {},
        {"crops": np.zeros((1, 128, 128, 4), np.uint8)},
        {"crops": np.zeros((1, 128, 128, 3), np.float32)},
        {"frame": np.zeros((1, 128, 128, 3), np.uint8)},
    ],
)
def test_a_graph_that_does_not_fit_its_inputs_is_refused_in_one_line(
    bundle: Bundle, feeds: dict[str, np.ndarray]
) -> None:
    session = bundle.session(trunk_file("float", 3))
    refused = pytest.raises(QsgmError, match=r"a graph of it does not fit .*; mend it")
    with refused as raised, running("it", "mend it"):
        session.run(None, feeds)
    assert "\n" not in str(raised.value)
