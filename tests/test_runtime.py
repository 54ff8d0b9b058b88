"""Sessions: exact integer products on every CPU, and graphs that do not fit are refused."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from onnx import helper

from qsgm import QsgmError
from qsgm.blocks import single_layers
from qsgm.bundle import Bundle
from qsgm.external_data import check_external_data
from qsgm.manifest import NETWORK, WEIGHTS, probe_file, step_file, trunk_file
from qsgm.runtime import check_interface, open_session, run_options, running
from qsgm.sgm.int8 import U8_ZERO, around_zero_point
from qsgm.train.graphs.inspection import integer_operators

LAST, ALL = range(4, 7), range(1, 7)


@pytest.mark.parametrize(
    "name",
    [
        trunk_file("int8", LAST),
        probe_file(3),
        step_file("int8", "sgd", single_layers(LAST)),
        step_file("int8", "sgd", single_layers(ALL)),
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
    model = onnx.load(bundle.folder / step_file("int8", "sgd", single_layers(LAST)))
    assert set(integer_operators(model)) == {"QGemm"}


def test_a_run_that_gives_its_memory_back_gives_the_same(bundle: Bundle) -> None:
    session = bundle.session(trunk_file("float", LAST))
    feeds = {"samples": np.random.default_rng(0).integers(0, 256, (2, 128, 128, 3), np.uint8)}
    options = run_options(give_memory_back=True)
    assert options.get_run_config_entry("memory.enable_memory_arena_shrinkage") == "cpu:0"
    plain, frugal, again = (session.run(None, feeds, some)[0] for some in (None, options, None))
    np.testing.assert_array_equal(frugal, plain)
    np.testing.assert_array_equal(again, plain)


def test_a_session_has_one_thread_unless_more_are_asked_for() -> None:
    model = model_of(graph_with([onnx.numpy_helper.from_array(np.ones(2, np.float32), "secret")]))
    for more, expected in (({}, 1), ({"threads": 2}, 2)):
        options = open_session(model.SerializeToString(), **more).get_session_options()
        assert options.intra_op_num_threads == expected


def test_what_is_no_graph_is_refused_in_one_line() -> None:
    with pytest.raises(QsgmError, match="cannot load a graph") as raised:
        open_session(b"not a graph")
    assert "\n" not in str(raised.value)


def tensor_in(location: str | None, **place: str) -> onnx.TensorProto:
    """A tensor that keeps its numbers elsewhere."""
    tensor = onnx.TensorProto(name="secret", dims=[2], data_type=onnx.TensorProto.FLOAT)
    tensor.data_location = onnx.TensorProto.EXTERNAL
    for key, value in ({} if location is None else {"location": location} | place).items():
        tensor.external_data.add(key=key, value=value)
    return tensor


def graph_with(
    initializers: Sequence[onnx.TensorProto] = (), nodes: Sequence[onnx.NodeProto] = ()
) -> onnx.GraphProto:
    copy = helper.make_node("Identity", ["secret"], ["y"])
    info = helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, None)
    return helper.make_graph([copy, *nodes], "g", [], [info], initializers)


def model_of(graph: onnx.GraphProto) -> onnx.ModelProto:
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)


def places_of_a_tensor(tensor: onnx.TensorProto) -> dict[str, onnx.ModelProto]:
    """Models with a tensor wherever one can be."""
    constant = helper.make_node("Constant", [], ["secret"], value=tensor)
    sparse = onnx.SparseTensorProto(values=tensor, dims=[2])
    inner = graph_with([tensor])
    loop = helper.make_node("If", ["c"], ["y"], then_branch=inner, else_branch=inner)
    many = helper.make_node("X", [], ["secret"])
    many.attribute.append(helper.make_attribute("all", [tensor]))
    graphs = helper.make_node("X", [], ["secret"])
    graphs.attribute.append(helper.make_attribute("all", [inner]))
    with_sparse = graph_with()
    with_sparse.sparse_initializer.append(sparse)
    function = model_of(graph_with())
    function.functions.add(name="f", domain="d").node.append(constant)
    training = model_of(graph_with())
    training.training_info.add().algorithm.CopyFrom(inner)
    return {
        "initializer": model_of(graph_with([tensor])),
        "attribute": model_of(graph_with((), [constant])),
        "list": model_of(graph_with((), [many])),
        "branch": model_of(graph_with((), [loop])),
        "list of graphs": model_of(graph_with((), [graphs])),
        "sparse": model_of(with_sparse),
        "function": function,
        "training": training,
    }


PLACES = places_of_a_tensor(tensor_in("/etc/passwd"))


@pytest.mark.parametrize("place", PLACES)
def test_a_model_that_keeps_numbers_in_another_file_is_refused_before_a_session_opens(
    place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ort, "InferenceSession", lambda *_, **__: pytest.fail("must not open"))
    with pytest.raises(QsgmError, match=r"keeps numbers in the file '/etc/passwd'") as raised:
        open_session(PLACES[place].SerializeToString(), files={"weights.bin": bytes(8)})
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("tensor", "expected"),
    [
        (tensor_in("../weights.bin"), r"'\.\./weights\.bin'"),
        (tensor_in("./weights.bin"), r"'\./weights\.bin'"),
        (tensor_in("WEIGHTS.BIN"), "'WEIGHTS.BIN'"),
        (tensor_in(""), "''"),
        (tensor_in(None), "''"),
        (tensor_in("weights.bin", offset="8", length="8"), "beyond the end"),
        (tensor_in("weights.bin", offset="-8", length="8"), "beyond the end"),
        (tensor_in("weights.bin", length="9" * 30), "beyond the end"),
        (tensor_in("weights.bin", offset="x"), "invalid literal"),
    ],
)
def test_only_the_files_that_belong_to_a_model_are_its_own(
    tensor: onnx.TensorProto, expected: str
) -> None:
    model = model_of(graph_with([tensor])).SerializeToString()
    with pytest.raises(QsgmError, match=expected):
        open_session(model, files={"weights.bin": bytes(8)})


def test_fields_of_fixed_length_are_passed_over() -> None:
    whole = model_of(graph_with([tensor_in("weights.bin")])).SerializeToString()
    fixed = b"\xa1\x06" + bytes(8) + b"\xa5\x06" + bytes(4)  # field 100 in 64 bits, and in 32
    onnx.load_model_from_string(fixed + whole)
    check_external_data(fixed + whole, {"weights.bin": b""})
    with pytest.raises(ValueError, match=r"'weights\.bin'"):
        check_external_data(fixed + whole, {})


@pytest.mark.parametrize(
    "field",
    [
        *(bytes([8 | kind]) for kind in (3, 4, 6, 7)),  # groups, and kinds that there are not
        b"\x88\x80\x80\x80\x10\x01",  # a tag of 33 bits, of which protobuf may take 32
    ],
)
def test_a_field_that_may_be_read_in_another_way_is_refused(field: bytes) -> None:
    whole = model_of(graph_with()).SerializeToString()
    check_external_data(whole, {})
    with pytest.raises(ValueError, match="not an ONNX file"):
        check_external_data(whole + field, {})


def test_a_tensor_that_is_described_twice_is_refused() -> None:
    # Protobuf joins what comes in parts; of two locations ONNX Runtime takes the last.
    tensor = tensor_in("weights.bin", length="8")
    tensor.external_data.add(key="location", value="/etc/passwd")
    with pytest.raises(QsgmError, match="'/etc/passwd'"):
        open_session(model_of(graph_with([tensor])).SerializeToString(), files={"weights.bin": b""})


def test_numbers_in_a_files_bytes_are_read_from_them_and_not_from_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "weights.bin").write_bytes(bytes(8))
    numbers = np.array([3, 4], np.float32)
    model = model_of(graph_with([tensor_in("weights.bin", offset="0", length="8")]))
    session = open_session(model.SerializeToString(), files={"weights.bin": numbers.tobytes()})
    np.testing.assert_array_equal(session.run(None, {})[0], numbers)


@pytest.mark.parametrize("end", range(1, 400, 7))
def test_the_walk_finds_what_onnx_finds_or_refuses(end: int, bundle: Bundle) -> None:
    whole = bytearray((bundle.folder / step_file("int8", "sgd", single_layers(LAST))).read_bytes())
    rng = np.random.default_rng(end)
    for place in rng.integers(0, len(whole), 3):
        whole[place] = rng.integers(256)
    try:
        model = onnx.load_model_from_string(bytes(whole))
        found = {
            entry.value
            for tensor in model.graph.initializer
            for entry in tensor.external_data
            if entry.key == "location"
        }
    except Exception:  # protobuf's own
        found = set()
    try:
        check_external_data(bytes(whole), {WEIGHTS: bytes(10**6), NETWORK: bytes(10**6)})
    except ValueError:
        return
    assert found <= {WEIGHTS, NETWORK}


def test_a_model_with_more_parts_than_any_graph_has_is_refused_in_time() -> None:
    with pytest.raises(QsgmError, match="too many parts"):
        open_session(b"\x08\x01" * 1_000_000)


CROPS = ("tensor(uint8)", (None, 128, 128, 3))


def test_the_interface_of_a_graph_is_checked_by_name_type_and_shape(bundle: Bundle) -> None:
    session = bundle.session(trunk_file("float", LAST))
    takes, gives = {"samples": CROPS}, {"features": ("tensor(uint8)", (None, None, None))}
    check_interface(session, "it", takes, gives, "mend it")
    for inputs, outputs in (
        ({"samples": ("tensor(float)", CROPS[1])}, gives),
        ({"samples": ("tensor(uint8)", CROPS[1][1:])}, gives),
        ({"samples": ("tensor(uint8)", (None, 127, 128, 3))}, gives),
        ({}, gives),
        (takes | {"more": CROPS}, gives),
        (takes, gives | {"more": CROPS}),
    ):
        with pytest.raises(QsgmError, match=r"it (takes|gives) .*expected .*; mend it$"):
            check_interface(session, "it", inputs, outputs, "mend it")


def test_a_graph_that_runs_out_of_memory_is_refused() -> None:
    with pytest.raises(QsgmError, match=r"MemoryError.*; mend it"), running("it", "mend it"):
        raise MemoryError


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
    session = bundle.session(trunk_file("float", LAST))
    refused = pytest.raises(QsgmError, match=r"a graph of it does not fit .*; mend it")
    with refused as raised, running("it", "mend it"):
        session.run(None, feeds)
    assert "\n" not in str(raised.value)


def test_of_a_graph_that_cannot_be_opened_nothing_is_said_but_the_refusal(
    capfd: pytest.CaptureFixture[str],
) -> None:
    empty = helper.make_model(helper.make_graph([], "empty", [], []), ir_version=8)
    with pytest.raises(QsgmError, match="cannot load"):
        open_session(empty.SerializeToString())
    assert capfd.readouterr() == ("", "")
