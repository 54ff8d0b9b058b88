"""Graphs of a bundle whose hashes are right: one that is another than its name says is refused."""

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import onnx
import pytest
from numpy.typing import NDArray
from onnx import ModelProto, TensorProto, ValueInfoProto, helper, numpy_helper
from runs import SHORT, Frame

from qsgm import QsgmError, finetune
from qsgm.bundle import Bundle, load_bundle
from qsgm.manifest import MANIFEST
from qsgm.tune import graphs
from qsgm.tune.plan import Plan, resolve

Values = list[ValueInfoProto]
OPEN: Mapping[str, Callable[[Bundle, Plan], object]] = {
    "trunk_float_3.onnx": graphs.open_trunk,
    "head_3.onnx": graphs.open_head,
    "step_int8_sgd_4,5,6.onnx": graphs.open_step,
    "probe_3.onnx": graphs.open_probe,
}


def value(name: str, kind: int, shape: list[int | str | None]) -> ValueInfoProto:
    return helper.make_tensor_value_info(name, kind, shape)


def shape_of(one: ValueInfoProto) -> list[int | str | None]:
    return [side.dim_value or side.dim_param for side in one.type.tensor_type.shape.dim]


def renamed(values: Values) -> None:
    values[0].name = "x"


def one_more(values: Values) -> None:
    values.append(value("more", TensorProto.FLOAT, [3]))


def retyped(values: Values) -> None:
    values[0].type.tensor_type.elem_type = TensorProto.DOUBLE


def of_more_axes(values: Values) -> None:
    values[0].CopyFrom(value(values[0].name, TensorProto.FLOAT, [*shape_of(values[0]), 1]))


def of_another_size(values: Values) -> None:
    *_, last = (one for one in values if isinstance((shape_of(one) or [None])[-1], int))
    *sides, side = shape_of(last)
    last.CopyFrom(value(last.name, last.type.tensor_type.elem_type, [*sides, side + 1]))


def missing(values: Values) -> None:
    values[:] = values[1:] or [value("other", TensorProto.FLOAT, [3])]


def impostor(
    model: ModelProto, inputs: Values, outputs: Values, answers: Mapping[str, NDArray]
) -> ModelProto:
    """A graph that takes and gives these values, whatever it takes: zeros, or these answers."""
    nodes = []
    for one in outputs:
        kind = helper.tensor_dtype_to_np_dtype(one.type.tensor_type.elem_type)
        sides = [side if isinstance(side, int) else 1 for side in shape_of(one)]
        tensor = numpy_helper.from_array(answers.get(one.name, np.zeros(sides, kind)))
        nodes.append(helper.make_node("Constant", [], [one.name], value=tensor))
    graph = helper.make_graph(nodes, "impostor", inputs, outputs)
    return helper.make_model(
        graph, ir_version=model.ir_version, opset_imports=list(model.opset_import)
    )


def exchanged(
    folder: Path,
    name: str,
    inputs: Callable[[Values], None] | None = None,
    outputs: Callable[[Values], None] | None = None,
    answers: Mapping[str, NDArray] | None = None,
) -> Bundle:
    """The bundle with an impostor under the name of a graph, and its hash."""
    model = onnx.load(str(folder / name), load_external_data=False)
    takes, gives = list(model.graph.input), list(model.graph.output)
    for change, values in ((inputs, takes), (outputs, gives)):
        if change is not None:
            change(values)
    data = impostor(model, takes, gives, answers or {}).SerializeToString()
    (folder / name).write_bytes(data)
    manifest = json.loads((folder / MANIFEST).read_text())
    manifest["files"][name]["sha256"] = hashlib.sha256(data).hexdigest()
    (folder / MANIFEST).write_text(json.dumps(manifest))
    return load_bundle(folder)


@pytest.mark.parametrize("name", OPEN)
@pytest.mark.parametrize(
    ("inputs", "outputs"),
    [
        (renamed, None),
        (one_more, None),
        (retyped, None),
        (of_more_axes, None),
        (of_another_size, None),
        (missing, None),
        (None, renamed),
        (None, retyped),
        (None, of_more_axes),
        (None, of_another_size),
        (None, missing),
    ],
)
def test_a_graph_that_takes_or_gives_something_else_is_refused_before_it_runs(
    own_bundle: Path,
    name: str,
    inputs: Callable[[Values], None] | None,
    outputs: Callable[[Values], None] | None,
) -> None:
    bundle = exchanged(own_bundle, name, inputs, outputs)
    with pytest.raises(QsgmError) as caught:
        OPEN[name](bundle, resolve(SHORT, bundle))
    said = str(caught.value)
    assert said.isprintable()
    assert f"{name} of the bundle" in said
    assert ("takes" if inputs else "gives") in said
    assert said.endswith("export it again with `qsgm fold-and-quantize`")


def test_a_message_names_what_differs_and_nothing_else(own_bundle: Path) -> None:
    bundle = exchanged(own_bundle, "step_int8_sgd_4,5,6.onnx", of_another_size)
    with pytest.raises(QsgmError, match=r"takes .*expected") as caught:
        graphs.open_step(bundle, resolve(SHORT, bundle))
    assert "'bias_momentum6': ('tensor(float)', [1, 4])" in str(caught.value)
    assert "'bias_momentum6': ('tensor(float)', (1, 3))" in str(caught.value)
    assert "weight5" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "answers"),
    [
        ("trunk_float_3.onnx", {"features": np.zeros((9, 169, 16), np.uint8)}),
        ("head_3.onnx", {"outputs": np.zeros((9, 3), np.float32)}),
        ("head_3.onnx", {"outputs": np.full((8, 3), np.nan, np.float32)}),
        ("step_int8_sgd_4,5,6.onnx", {"loss": np.float32(np.nan)}),
        ("step_int8_sgd_4,5,6.onnx", {"weight4_next": np.full((16, 400), np.inf, np.float32)}),
        ("probe_3.onnx", {"int84": np.zeros((5, 1, 16), np.float32)}),
    ],
)
@pytest.mark.usefixtures("few_crops")
def test_a_graph_that_answers_what_it_does_not_promise_ends_in_one_line(
    own_bundle: Path, frame: Frame, name: str, answers: Mapping[str, NDArray]
) -> None:
    bundle = exchanged(own_bundle, name, answers=answers)
    with pytest.raises(QsgmError, match=r"does not fit|diverged") as caught:
        finetune(frame, bundle, SHORT)
    assert str(caught.value).isprintable()
