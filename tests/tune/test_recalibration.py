"""Other ranges for int8 SGMs, exchanged in a session: the graph is left as it was exported."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from qsgm import QsgmError, cli
from qsgm.blocks import parse_blocks
from qsgm.bundle import Bundle
from qsgm.fidelity import cosine
from qsgm.grasp.task import GraspTask
from qsgm.grasp.teach import prepare_object, tune_object
from qsgm.manifest import probe_file
from qsgm.runtime import open_session
from qsgm.sgm.float import FloatArray, FoldedConv, FoldedSgm, float_trace
from qsgm.sgm.int8 import (
    QuantizedSgm,
    SgmRanges,
    constants,
    constants_of_two_planes,
    integer_forward,
    quantize_sgm,
)
from qsgm.task import label_span
from qsgm.train.graphs.build import Graph
from qsgm.train.graphs.sgm import int8_sgm
from qsgm.train.graphs.sharing import SharedConstants
from qsgm.tune.graphs import constants_of
from qsgm.tune.plan import resolve
from qsgm.tune.recalibrate import activations_before, grown, ranges_of, recalibrated, typical_labels
from qsgm.tune.settings import Settings

Frame = NDArray[np.uint8]
SPAN = label_span(GraspTask().heads)
# Of a negative, and of positives at every eighth of the circle that sine and cosine go round.
LABELS = np.array(
    [[0, 0, 0], *([1, np.sin(turn), np.cos(turn)] for turn in np.arange(8) * np.pi / 4)],
    np.float32,
)

KERNELS = pytest.mark.parametrize(("kernel", "side"), [(1, 1), (3, 4)], ids=["1x1", "3x3"])


def random_sgm(rng: np.random.Generator, kernel: int, side: int) -> FoldedSgm:
    convs = []
    for into, out in pairwise((8 + 3, 20, 12, 8)):
        weight, bias = rng.normal(size=(out, into, kernel, kernel)), rng.normal(size=out)
        convs.append(FoldedConv(weight.astype(np.float32) / kernel, bias.astype(np.float32)))
    return FoldedSgm(4 if kernel == 1 else 2, (side, side), tuple(convs))


def random_seen(rng: np.random.Generator, side: int) -> FloatArray:
    """Activations (40, P, 8) and one of the labels each."""
    activation = np.abs(rng.normal(size=(40, side**2, 8)))
    labels = LABELS[rng.integers(len(LABELS), size=40)]
    return np.concatenate(
        [activation, np.tile(labels[:, None], (1, side**2, 1))], axis=2, dtype=np.float32
    )


def write_graph(q: QuantizedSgm, side: int) -> tuple[bytes, dict[str, bytes]]:
    """The SGM alone as a graph, its constants in a file beside it."""
    graph = Graph("sgm")
    op = graph.within(f"layer{q.layer}")
    shape = side**2, len(q.products[-1].bias)
    maps = graph.input("seen", np.float32, ("batch", side**2, len(q.input_low)))
    seen = op.Reshape(maps, op.shape(-1, len(q.input_low)))
    gradient = op.Reshape(int8_sgm(op, q, seen), op.shape(-1, *shape))
    graph.output("gradient", gradient, np.float32, ("batch", *shape))
    model, shared = graph.model(), SharedConstants("weights.bin")
    shared.take_from([model])
    return model.SerializeToString(), {"weights.bin": bytes(shared.data)}


@KERNELS
def test_exchanged_constants_make_the_graph_the_other_sgm_bit_for_bit(
    kernel: int, side: int
) -> None:
    rng = np.random.default_rng(0)
    sgm = random_sgm(rng, kernel, side)
    seen = random_seen(rng, side)
    own, other = (
        quantize_sgm(sgm, ranges_of(sgm, scale * seen[..., :8], LABELS, SPAN))
        for scale in (0.01, 1.0)
    )
    graph, files = write_graph(own, side)
    for q, exchanged in ((own, {}), (other, constants(other))):
        session = open_session(graph, 1, exchanged, files)
        gradient = session.run(None, {"seen": seen})[0]
        np.testing.assert_array_equal(gradient, integer_forward(q, seen)[0])


@KERNELS
def test_a_graph_of_two_planes_gives_the_gradients_of_8_bit_sgms(kernel: int, side: int) -> None:
    rng = np.random.default_rng(1)
    sgm = random_sgm(rng, kernel, side)
    seen = random_seen(rng, side)
    ranges = ranges_of(sgm, seen[..., :8], LABELS, SPAN)
    graph, files = write_graph(quantize_sgm(sgm, ranges), side)
    for weight_bits in (16, 8, 4):
        q = quantize_sgm(sgm, ranges, 8, weight_bits)
        session = open_session(graph, 1, constants_of_two_planes(q), files)
        gradient = session.run(None, {"seen": seen})[0]
        np.testing.assert_array_equal(gradient, integer_forward(q, seen)[0])


def test_ranges_cover_what_the_sgm_holds_under_any_label() -> None:
    rng = np.random.default_rng(2)
    for kernel, side in ((1, 1), (3, 4)):
        sgm, seen = random_sgm(rng, kernel, side), random_seen(rng, side)
        ranges = ranges_of(sgm, seen[..., :8], LABELS, SPAN)
        assert (ranges.input_low <= seen.min(axis=(0, 1))).all()
        assert (ranges.input_high >= seen.max(axis=(0, 1))).all()
        for high, tensor in zip(ranges.hidden_high, float_trace(sgm, seen)[1], strict=True):
            assert (high >= tensor.max(axis=(0, 1)) - 1e-5).all()


def test_grown_ranges_leave_labels_alone() -> None:
    ranges = SgmRanges(np.zeros(5, np.float32), np.ones(5, np.float32), (np.ones(4, np.float32),))
    wide = grown(ranges, 1.5, 3)
    np.testing.assert_array_equal(wide.input_high, np.float32([1.5, 1.5, 1, 1, 1]))
    np.testing.assert_array_equal(wide.hidden_high[0], np.full(4, 1.5, np.float32))


def test_recalibration_mends_ranges_that_are_far_too_narrow(frame: Frame, bundle: Bundle) -> None:
    settings = Settings(precision="int8", epochs=1, layers=3)
    plan = resolve(settings, bundle)
    prepared = prepare_object(frame, bundle, plan)
    activations = activations_before(prepared, plan)
    assert sorted(activations) == [4, 5]
    hostile = {}
    for layer, activation in activations.items():
        sgm = bundle.float_sgm(layer)
        narrow = quantize_sgm(sgm, ranges_of(sgm, 0.02 * activation, LABELS, SPAN), 8)
        hostile[layer] = constants_of_two_planes(narrow)
    asked = resolve(replace(settings, recalibrate=True), bundle)
    clipping, mended = (
        tune_object(prepared, replace(one, overrides=hostile)) for one in (plan, asked)
    )
    for layer in (4, 5):
        assert clipping.fidelity[layer].clipped_fraction > 0.05
        assert clipping.fidelity[layer].cos_int8_float < 0.99
        assert mended.fidelity[layer].clipped_fraction == 0
        assert mended.fidelity[layer].cos_int8_float > 0.999


@pytest.mark.parametrize("blocks", ["3,4,5,6", "1-4,5,6"])
def test_vectors_behind_maps_are_calibrated_on_as_many_crops_as_without_maps(
    blocks: str, frame: Frame, bundle: Bundle
) -> None:
    settings = Settings(precision="int8", layers=len(parse_blocks(blocks).layers), blocks=blocks)
    plan = resolve(settings, bundle)
    prepared = prepare_object(frame, bundle, plan)
    for layer, activation in activations_before(prepared, plan).items():
        crops, positions = activation.shape[:2]
        assert (crops, positions) == ((16, 169) if layer == 3 else (400, 1))


@pytest.mark.parametrize(
    "options",
    [
        ["--method", "bp"],
        ["--method", "bp", "--blocks", "4-6"],
        ["--float"],
        ["--layers", "1"],
    ],
)
def test_a_run_without_int8_sgms_has_nothing_to_recalibrate(
    options: list[str],
    frame_path: Path,
    bundle_folder: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    start = ["finetune", "--recalibrate", "--epochs", "1", "--bundle", str(bundle_folder)]
    assert cli.run([*start, *options, str(frame_path)]) == 1
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("error: there is nothing to recalibrate")


def test_a_recalibrated_run_says_so_and_how_long_it_took(
    frame_path: Path, bundle_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    start = ["finetune", "--recalibrate", "--epochs", "1", "--bundle", str(bundle_folder)]
    assert cli.run([*start, "--blocks", "4,5-6", "--json", str(frame_path)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["recalibrated"] is True
    assert report["seconds"]["recalibration"] > 0


def test_a_bundle_without_a_probe_cannot_recalibrate(frame: Frame, bundle: Bundle) -> None:
    files = {k: v for k, v in bundle.manifest.files.items() if k != probe_file(3)}
    without = replace(bundle, manifest=replace(bundle.manifest, files=files))
    plan = resolve(Settings(precision="int8", epochs=1, recalibrate=True), without)
    with pytest.raises(QsgmError, match=r"has no probe_3.onnx, by which SGMs are looked at"):
        tune_object(prepare_object(frame, without, plan), plan)


def test_a_bundles_probe_takes_recalibrated_constants_for_all_its_sgms(
    frame: Frame, bundle: Bundle
) -> None:
    rng = np.random.default_rng(3)
    plan = resolve(Settings(precision="int8", epochs=0, layers=3), bundle)
    prepared = prepare_object(frame, bundle, plan)
    found, labels = activations_before(prepared, plan), typical_labels(prepared.labels[:800])
    exchanged = recalibrated(bundle, found, labels)
    session = bundle.session(probe_file(3), 1, constants_of(exchanged, (4, 5)))
    feeds = {"features": prepared.features, "labels": prepared.labels, **prepared.start}
    rows = rng.choice(800, 32, replace=False)
    for layer in (4, 5):
        names = [f"activation{layer}", f"int8{layer}", f"float{layer}"]
        activation, int8, floating = session.run(names, {**feeds, "rows": rows})
        beside = prepared.labels[rows][:, None].repeat(activation.shape[1], axis=1)
        seen = np.concatenate([activation, beside], axis=2)
        sgm = bundle.float_sgm(layer)
        q = quantize_sgm(sgm, ranges_of(sgm, found[layer], labels, SPAN))
        np.testing.assert_array_equal(int8, integer_forward(q, seen)[0])
        np.testing.assert_allclose(floating, float_trace(sgm, seen)[0], atol=1e-5)
        assert cosine(int8, floating) > 0.999
