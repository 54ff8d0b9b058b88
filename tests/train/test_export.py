"""From checkpoint to bundle: it loads, it holds the numbers, and nothing else is left behind."""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from rich.console import Console
from toys import by_correlation

from qsgm import QsgmError
from qsgm.blocks import parse_blocks, single_layers
from qsgm.bundle import Bundle, load_bundle
from qsgm.grasp.network import GRASPNET
from qsgm.grasp.task import GraspTask, distractors_of, task_of
from qsgm.grasp.tuned import ObjectDescription, save_object
from qsgm.manifest import NETWORK, Recipe
from qsgm.schedule import BATCH
from qsgm.task import task_record
from qsgm.train import export
from qsgm.train.checkpoint import Checkpoint, save_checkpoint
from qsgm.train.export import ExportOptions
from qsgm.train.export_report import ExportReport
from qsgm.train.graphs.inspection import refuse_float_products
from qsgm.train.graphs.memory import step_memory
from qsgm.train.grasp import export as grasp_export
from qsgm.train.grasp.calibration_set import CalibrationLessons, CalibrationSet
from qsgm.train.grasp.draw_calibration import draw_calibration_set
from qsgm.train.grasp.draw_distractors import SHEET_SEED, distractor_file
from qsgm.train.grasp.export import fold_and_quantize
from qsgm.train.model.fold import fold_net
from qsgm.train.model.net import ConvNet
from qsgm.train.model.sgm import Sgm
from qsgm.train.quantization import calibration_runs
from qsgm.tune.loop import StepLoop
from qsgm.weights import to_step_layout

RATES = {"6": (4e-3,), "5,6": (2e-3, 3e-3), "4,5,6": (1e-3, 2e-3, 3e-3)}
RATES["4-5,6"] = (5e-3, 6e-3, 7e-3)
GRAPHS = {
    "network.onnx",
    *(f"{kind}_{n}.onnx" for kind in ("trunk_int8", "trunk_float", "head") for n in (1, 2, 3)),
    *(f"step_float_{name}_{b}.onnx" for name in ("sgd", "adam") for b in ("6", "5-6", "4-6")),
    *(
        f"step_{precision}_sgd_{blocks}.onnx"
        for precision in ("int8", "float")
        for blocks in ("5,6", "4,5,6", "4,5-6", "4-5,6")
    ),
    *(
        f"step_{precision}_adam_{b}.onnx"
        for precision in ("int8", "float")
        for b in ("5,6", "4,5,6")
    ),
    "probe_2.onnx",
    "probe_3.onnx",
}
FIDELITY = {
    "cos_int8_float",
    "cos_int8_true",
    "cos_float_true",
    "norm_ratio_int8_true",
    "sign_agreement_int8_float",
    "sqnr_db",
    "clipped_fraction",
}


def ignore(_stage: str, _done: int, _of: int) -> None:
    pass


class Workplace:
    """A tiny checkpoint, a tiny calibration set, and exports of them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        torch.manual_seed(0)
        self.net = ConvNet(GRASPNET).eval()
        sgms = {layer: Sgm(GRASPNET, layer, (8, 6)).eval() for layer in (4, 5)}
        self.checkpoint = Checkpoint(
            task_record(GraspTask()), self.net, sgms, {}, RATES, {"seed": 11}
        )
        save_checkpoint(folder / "sgm.pt", self.checkpoint)
        draw_calibration_set(folder / "calib", count=2, seed=5)

    def export(self, name: str) -> ExportReport:
        paths = (self.folder / part for part in ("sgm.pt", "calib", name))
        options = ExportOptions(epochs=1, blocks=(parse_blocks("4-5,6"),))
        return fold_and_quantize(*paths, ignore, options)


@pytest.fixture(autouse=True, scope="module")
def small_and_on_one_thread() -> Iterator[None]:
    """Threads that wait for each other on a busy machine take longer than this work does."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(calibration_runs, "CROPS", 70)
        yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def workplace(tmp_path_factory: pytest.TempPathFactory) -> Workplace:
    return Workplace(tmp_path_factory.mktemp("export"))


@pytest.fixture(scope="module")
def report(workplace: Workplace, small_and_on_one_thread: None) -> ExportReport:  # noqa: ARG001
    return workplace.export("first")


@pytest.fixture(scope="module")
def bundle(report: ExportReport) -> Bundle:
    return load_bundle(Path(report.output))


def test_the_bundle_holds_every_graph_and_nothing_else(bundle: Bundle) -> None:
    data = {"weights.bin", "distractors.png"}
    assert set(bundle.manifest.files) == GRAPHS | data
    others = {"manifest.json", "README.md", "SHA256SUMS"}
    assert {path.name for path in bundle.folder.iterdir()} == GRAPHS | data | others
    for name in GRAPHS:
        entry, data = bundle.manifest.files[name], (bundle.folder / name).read_bytes()
        assert entry.sha256 == hashlib.sha256(data).hexdigest()
        assert (entry.peak_activation_bytes is not None) == name.startswith("step")
        onnx.checker.check_model(onnx.load(bundle.folder / name), full_check=True)


def test_the_bundle_brings_the_things_that_ship(bundle: Bundle) -> None:
    things = distractors_of(bundle)
    assert things is not None
    assert (len(things), things.named) == (24, 0)
    assert (bundle.folder / "distractors.png").read_bytes() == distractor_file(SHEET_SEED)


def test_the_checkpoints_decision_goes_into_the_manifest(workplace: Workplace) -> None:
    trainee = calibration_runs.prepare(workplace.checkpoint)
    files = {NETWORK: (workplace.folder / "first" / NETWORK).read_bytes()}
    assert "decision" not in export.describe(trainee, [], files, {}).to_json()["task"]
    task = task_record(GraspTask(decision=by_correlation()))
    decided = replace(trainee, checkpoint=replace(trainee.checkpoint, task=task))
    described = export.describe(decided, [], files, {}).to_json()
    assert described["task"]["decision"] == by_correlation().to_json()


def test_the_manifest_says_what_memory_steps_take(bundle: Bundle) -> None:
    blocks = parse_blocks("4,5,6")
    expected = step_memory(bundle, "int8", blocks, BATCH).peak
    assert bundle.peak_activation_bytes("step_int8_sgd_4,5,6.onnx") == expected > 0


def test_the_manifest_gives_the_loss_and_the_recipes(bundle: Bundle) -> None:
    assert task_of(bundle) == GraspTask("double", 0.05)
    assert bundle.manifest.heads == GraspTask("double", 0.05).heads
    assert bundle.manifest.most_layers == 3
    assert bundle.manifest.blocks == ("6", "5,6", "4,5,6", "4,5-6", "4-5,6")
    for text in ("5,6", "4,5,6", "4-5,6"):
        blocks = parse_blocks(text)
        tuned, layers = len(blocks.layers), blocks.layers
        assert bundle.recipe("sgm", layers, None, blocks) == Recipe("sgd", RATES[text])
        if text != "4-5,6":
            assert bundle.recipe("sgm", layers, "adam", blocks).rates == (2e-3,) * tuned
    # Without rates of their own, blocks get those of as many layers on their own.
    assert (
        bundle.recipe("sgm", GRASPNET.last(3), None, parse_blocks("4,5-6")).rates == RATES["4,5,6"]
    )
    assert bundle.recipe("sgm", GRASPNET.last(3), None).rates == RATES["4,5,6"]
    assert bundle.recipe("sgm", GRASPNET.last(1), None) == Recipe("sgd", RATES["6"])
    assert bundle.recipe("bp", GRASPNET.last(1), None) == Recipe("adam", (1e-3,))
    assert bundle.recipe("bp", GRASPNET.last(3), None).rates == (1e-3,) * 3
    assert bundle.recipe("bp", GRASPNET.last(3), "sgd").rates == (1e-2,) * 3


def test_start_weights_are_the_folded_checkpoints(workplace: Workplace, bundle: Bundle) -> None:
    weights = bundle.start_weights(GRASPNET.last(3))
    folded = fold_net(workplace.net)
    assert len(weights) == 6
    for number in (4, 5, 6):
        layer = folded.layers[number - 1]
        np.testing.assert_array_equal(weights[f"weight{number}"], layer.weight)
        np.testing.assert_array_equal(weights[f"bias{number}"], layer.bias)
    assert bundle.network_with(weights) == (bundle.folder / "network.onnx").read_bytes()


def test_blocks_of_several_layers_are_trained_with_sgd_only(bundle: Bundle) -> None:
    with pytest.raises(QsgmError, match=r"has no rates for adam on the blocks 4-5,6; .* sgd"):
        bundle.recipe("sgm", GRASPNET.last(3), "adam", parse_blocks("4-5,6"))


@pytest.mark.parametrize("precision", ["int8", "float"])
@pytest.mark.parametrize(
    ("blocks", "optimizer"),
    [(blocks, name) for blocks in ("5,6", "4,5,6") for name in ("sgd", "adam")]
    + [("4-5,6", "sgd")],
)
def test_exported_steps_train(bundle: Bundle, blocks: str, optimizer: str, precision: str) -> None:
    session = bundle.session(f"step_{precision}_{optimizer}_{blocks}.onnx")
    tuned = len(parse_blocks(blocks).layers)
    rng = np.random.default_rng(0)
    features = rng.integers(0, 256, (40, 169 if tuned == 3 else 1, 16), dtype=np.uint8)
    labels = rng.uniform(0, 1, (40, 3)).astype(np.float32)
    start = {
        name: to_step_layout(value) if value.ndim > 1 else value
        for name, value in bundle.start_weights(GRASPNET.last(tuned)).items()
    }
    loop = StepLoop(session, features, labels, start, dict.fromkeys(range(7 - tuned, 7), 1e-2))
    losses = [loop.step(rng.permutation(40)[:32]) for _ in range(5)]
    assert np.isfinite(losses).all()
    assert not np.array_equal(loop.weights()["weight6"], start["weight6"])


def test_the_report_has_its_keys(workplace: Workplace, report: ExportReport) -> None:
    values = report.to_json()
    assert json.loads(json.dumps(values, allow_nan=False)) == values
    assert values["output"] == str(workplace.folder / "first")
    assert values["calibrator"] == {"4": "minmax", "5": "minmax"}
    assert set(values["layers"]) == {"4", "5"}
    for layer in values["layers"].values():
        assert set(layer) >= FIDELITY | {"range", "bytes"}
    assert values["fold_max_abs_error"] < 1e-4
    # (19*8+8) + (8*6+6) + (6*16+16) numbers; in int8 each weight has two planes, every row a
    # scale and a bias, every input an offset and a gain, and the low plane a step and a zero point.
    assert values["bytes"]["float"] == 2 * 4 * (160 + 54 + 112)
    assert values["bytes"]["int8"] == 2 * (2 * (152 + 48 + 96) + 8 * (8 + 6 + 16) + 8 * 19 + 5)
    sizes = [
        (workplace.folder / "first" / name).stat().st_size
        for name in {*GRAPHS, "weights.bin", "distractors.png"}
    ]
    assert values["bundle_bytes"] == sum(sizes)


def test_the_table_and_the_model_card_show_every_layer(
    workplace: Workplace, report: ExportReport
) -> None:
    shown = StringIO()
    Console(file=shown, width=160).print(report)
    card = (workplace.folder / "first/README.md").read_text()
    for layer, one in report.layers.items():
        cosine = f"{one.fidelity.cos_int8_float:.5f}"
        assert f"| {layer} | " in card
        assert cosine in card
        assert cosine in shown.getvalue()
    assert '"seed": 11' in card
    assert "for the task `grasp`" in card
    assert "| `distractors.png` |" in card
    assert "`step_float_*_A-6.onnx`" in card


def test_the_same_checkpoint_gives_the_same_bytes(
    workplace: Workplace, report: ExportReport
) -> None:
    workplace.export("second")
    first, second = Path(report.output), workplace.folder / "second"
    for path in first.iterdir():
        assert path.read_bytes() == (second / path.name).read_bytes(), path.name
    workplace.export("second")  # an earlier bundle is replaced


@pytest.mark.parametrize("change", ["missing", "altered"])
def test_a_missing_or_altered_graph_is_refused(
    workplace: Workplace, tmp_path: Path, report: ExportReport, change: str
) -> None:
    copy = tmp_path / "bundle"
    copy.mkdir()
    for path in Path(report.output).iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    load_bundle(copy)
    if change == "missing":
        (copy / "probe_2.onnx").unlink()
    else:
        (copy / "probe_2.onnx").write_bytes((copy / "probe_3.onnx").read_bytes())
    with pytest.raises(QsgmError, match=r"probe_2\.onnx"):
        load_bundle(copy)
    assert workplace.folder.is_dir()


@pytest.mark.parametrize("text", ["3,4-5,6", "4-6", "6"])
def test_blocks_without_their_sgms_are_refused(text: str) -> None:
    with pytest.raises(QsgmError, match=f"cannot export steps for the blocks {text}: .* 3 layers"):
        export.exported_blocks(GRASPNET, 3, [parse_blocks(text)])


def test_a_checkpoint_of_six_layers_exports_all_of_them() -> None:
    texts = [str(blocks) for blocks in export.exported_blocks(GRASPNET, 6, [])]
    assert texts[:6] == [str(single_layers(GRASPNET.last(tuned))) for tuned in range(1, 7)]
    assert texts[6:] == ["4,5-6", "3-4,5,6", "2-4,5,6", "1-4,5,6"]
    assert [str(blocks) for blocks in export.exported_blocks(GRASPNET, 1, [])] == ["6"]


def test_a_failure_leaves_nothing_behind(
    workplace: Workplace, report: ExportReport, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = sorted(path.name for path in workplace.folder.iterdir())
    kept = (Path(report.output) / "manifest.json").read_bytes()

    def fail(*_: Any) -> str:
        raise QsgmError("no card today")

    monkeypatch.setattr(export, "model_card", fail)
    for name in ("first", "third"):
        with pytest.raises(QsgmError, match="no card today"):
            workplace.export(name)
    assert sorted(path.name for path in workplace.folder.iterdir()) == before
    assert (Path(report.output) / "manifest.json").read_bytes() == kept


def test_a_folder_with_something_else_is_refused_before_any_work(
    workplace: Workplace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(export, "load_checkpoint", pytest.fail)
    monkeypatch.setattr(grasp_export, "load_checkpoint", pytest.fail)
    with pytest.raises(QsgmError, match=r"it holds another kind of output|did not write"):
        fold_and_quantize(Path("sgm.pt"), Path("calib"), workplace.folder, ignore)


def test_folding_that_changes_outputs_is_refused(workplace: Workplace) -> None:
    trainee = calibration_runs.prepare(workplace.checkpoint)
    lessons = CalibrationLessons(CalibrationSet(workplace.folder / "calib"), GraspTask())
    assert export.check_folding(trainee, lessons) < 1e-4
    trainee.sgms[5].convs[1].bias[0] += 0.1
    with pytest.raises(QsgmError, match="folding batchnorm changes the SGM behind layer 5"):
        export.check_folding(trainee, lessons)


def test_a_product_left_in_float_is_refused_with_its_layer(bundle: Bundle) -> None:
    model = onnx.load(bundle.folder / "step_int8_sgd_4,5,6.onnx")
    refuse_float_products("step", model)
    # ONNX Runtime has no integer product with a factor on its sum and a bias.
    gemm = [
        node
        for node in model.graph.node
        if node.op_type == "Gemm" and node.output[0].startswith("layer5")
    ][2]
    gemm.attribute.append(onnx.helper.make_attribute("alpha", 2.0))
    with pytest.raises(QsgmError, match=r"step: .* computes 5 of the 6 int8 products of layer5"):
        refuse_float_products("step", model)


def test_a_bundle_a_calibration_set_and_an_object_never_replace_each_other(
    workplace: Workplace, bundle: Bundle, tmp_path: Path
) -> None:
    tuned = tmp_path / "tuned"
    save_object(tuned, ObjectDescription("mug", "double", 0.0), bundle.network_with({}), {})
    calib = workplace.folder / "calib"
    kinds = {
        bundle.folder: lambda folder: draw_calibration_set(folder, 1, 0),
        calib: lambda folder: fold_and_quantize(Path("sgm.pt"), calib, folder, ignore),
        tuned: lambda folder: fold_and_quantize(Path("sgm.pt"), calib, folder, ignore),
    }
    for folder, write in kinds.items():
        before = sorted(path.name for path in folder.iterdir())
        with pytest.raises(QsgmError, match="it holds another kind of output"):
            write(folder)
        assert sorted(path.name for path in folder.iterdir()) == before


def test_the_table_fits_a_terminal_of_80_columns(report: ExportReport) -> None:
    shown = StringIO()
    Console(file=shown, width=80).print(report)
    lines = shown.getvalue().splitlines()
    headers = ["int8,float", "int8,true", "ratio", "[dB]", "int8/float"]
    assert any(all(header in line for header in headers) for line in lines)
    for layer, one in report.layers.items():
        row = next(line for line in lines if line.split()[:1] == [str(layer)])
        assert row.split() == list(one.cells())
