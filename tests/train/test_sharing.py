"""Constants of many graphs in one file: stored once, found by any runtime, the graphs unchanged."""

from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort

from qsgm.train.graphs.build import Graph
from qsgm.train.graphs.sharing import ALIGNMENT, LEAST_BYTES, SharedConstants

RNG = np.random.default_rng(0)
BIG, OTHER = RNG.normal(size=(2, 16, 16)).astype(np.float32)


def times(weight: np.ndarray, name: str) -> onnx.ModelProto:
    """x (B, 16) @ weight + 1, the weight under a name of its own."""
    graph = Graph("times")
    op = graph.within("layer")
    x = graph.input("x", np.float32, ("batch", 16))
    product = op.MatMul(x, graph.initializer(name, weight))
    graph.output("y", op.Add(product, op.constant(1.0)), np.float32, ("batch", 16))
    return graph.model()


def test_equal_constants_are_stored_once_and_every_graph_finds_them(tmp_path: Path) -> None:
    models = {"a": times(BIG, "w"), "b": times(BIG, "other_name"), "c": times(OTHER, "w")}
    shared = SharedConstants("weights.bin")
    shared.take_from(models.values())
    (tmp_path / "weights.bin").write_bytes(shared.data)
    assert len(shared.data) == 2 * BIG.nbytes
    x = RNG.normal(size=(3, 16)).astype(np.float32)
    for name, model in models.items():
        onnx.save(model, tmp_path / f"{name}.onnx")
        onnx.checker.check_model(str(tmp_path / f"{name}.onnx"), full_check=True)
        session = ort.InferenceSession(
            str(tmp_path / f"{name}.onnx"), providers=["CPUExecutionProvider"]
        )
        weight = OTHER if name == "c" else BIG
        np.testing.assert_allclose(session.run(None, {"x": x})[0], x @ weight + 1, atol=1e-5)


def test_small_constants_stay_in_their_graph_unless_they_are_to_be_exchanged() -> None:
    small = np.ones((1, LEAST_BYTES // 4 - 1), np.float32)
    for name, places in (("w", 0), ("sgm4/low", 1)):
        graph = Graph("small")
        op = graph.within("layer")
        x = graph.input("x", np.float32, ("batch", small.shape[1]))
        graph.output("y", op.Add(x, graph.initializer(name, small)), np.float32, ("batch", "c"))
        model = graph.model()
        shared = SharedConstants("weights.bin")
        shared.take_from([model])
        assert len(shared.data) == places * small.nbytes
        outside = [t for t in model.graph.initializer if t.data_location == t.EXTERNAL]
        assert [t.name for t in outside] == [name] * places


def test_every_place_is_aligned_and_an_array_is_read_back_from_its_own() -> None:
    shared = SharedConstants("weights.bin")
    arrays = [RNG.normal(size=size).astype(np.float32) for size in (3, 50, 7)]
    places = [shared.add_array(array) for array in [*arrays, arrays[1]]]
    assert places[3] == places[1]
    for array, place in zip(arrays, places, strict=False):
        assert place.offset % ALIGNMENT == 0
        found = np.frombuffer(shared.data, "<f4", count=array.size, offset=place.offset)
        np.testing.assert_array_equal(found.reshape(place.shape), array)
