"""`qsgm fold-and-quantize`: from `sgm.pt` and a calibration set to the bundle that a device runs.

Fold, calibrate, quantize, build every graph, look whether ONNX Runtime makes integer operators of
the int8 ones, and write the lot with a manifest and a model card. The same checkpoint and the
same frames give the same bytes.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from onnx import ModelProto

from qsgm.blocks import LAYERS, Blocks, one_block, parse_blocks, single_layers, tuned_layers
from qsgm.bundle import (
    FORMAT,
    MANIFEST,
    NETWORK,
    PRECISIONS,
    VERSION,
    WEIGHTS,
    Bundle,
    OptimizerName,
    Precision,
    head_file,
    probe_file,
    step_file,
    trunk_file,
)
from qsgm.errors import QsgmError
from qsgm.files import check_replaceable, new_folder
from qsgm.grasp.crops import cut_crops, label_crops, plan_crops
from qsgm.grasp.distractors import FILE as DISTRACTORS
from qsgm.sgm.float import FoldedSgm
from qsgm.sgm.int8 import ActivationBits, QuantizedSgm, quantize_sgm
from qsgm.train.checkpoint import Checkpoint, load_checkpoint
from qsgm.train.export_report import ExportReport, LayerReport, Provenance, model_card
from qsgm.train.graphs.inspection import refuse_float_products
from qsgm.train.graphs.optimizers import Adam, Optimizer, Sgd
from qsgm.train.graphs.probe import head_model, probe_model
from qsgm.train.graphs.sharing import SharedConstants, constants_elsewhere
from qsgm.train.graphs.step import AnySgm, step_model
from qsgm.train.graphs.trunk import (
    initializer_offsets,
    int8_trunk_model,
    network_model,
    trunk_model,
)
from qsgm.train.grasp.draw_distractors import SHEET_SEED, distractor_file
from qsgm.train.liveness import graph_memory
from qsgm.train.model.curvature import FLAT
from qsgm.train.model.fold import (
    FoldedNet,
    net_fold_error,
    run_folded,
    run_folded_sgm,
    sgm_fold_error,
)
from qsgm.train.model.graspnet import normalize
from qsgm.train.quantization.calibrate import AUTO, calibrate
from qsgm.train.quantization.calibration_runs import EPOCHS, Trainee, prepare
from qsgm.train.quantization.calibration_set import CalibrationSet, Demonstration, Watch
from qsgm.train.quantization.sgm_fidelity import measure
from qsgm.train.quantization.trunk import QuantizedLayer, feature_steps, quantize_trunk
from qsgm.train.quantization.trunk_ranges import observe_trunk
from qsgm.tune.loop import BATCH

SEED = 0
# Of the frozen layers, unless the user says otherwise: in int8 they take longer (README).
TRUNK: Precision = "float"
OPTIMIZERS: dict[OptimizerName, Optimizer] = {"sgd": Sgd(), "adam": Adam()}
# Exported beside each layer on its own, as far as the checkpoint can tune so many layers.
GROUPED = ("4,5-6", "3-4,5,6", "2-4,5,6", "1-4,5,6")
# Folding moves rounding errors about, no more: larger than this, it went wrong.
LARGEST_FOLD_ERROR = 1e-4  # relative to the largest output
FOLD_CROPS = 64
# SGD's rates for the SGMs are meta-trained; these are the usual ones, for every layer.
BACKPROP_RATES = {"sgd": 1e-2, "adam": 1e-3}
SGM_ADAM_RATE = 2e-3
# As many as were meta-trained together, and for which the gain of short runs was found.
MAML_LAYERS = 3


def fold_and_quantize(
    checkpoint_path: Path,
    calib_folder: Path,
    output_folder: Path,
    watch: Watch,
    epochs: int = EPOCHS,
    blocks: Sequence[Blocks] = (),
    calibrator: str = AUTO,
    activation_bits: ActivationBits = 16,
) -> ExportReport:
    """Export a checkpoint as a bundle.

    Args:
        checkpoint_path: `sgm.pt`.
        calib_folder: a calibration set, see :mod:`qsgm.train.grasp.draw_calibration`.
        output_folder: absent, empty, or an earlier bundle.
        watch: told about progress.
        epochs: length of each fine-tuning run that ranges are taken along.
        blocks: to be tuned beside :data:`GROUPED` and each layer on its own.
        calibrator: whose ranges the SGMs get, see
            :func:`qsgm.train.quantization.calibrate.calibrate`.
        activation_bits: of the int8 SGMs' inputs and hidden tensors, in one u8 plane or two.

    Raises:
        QsgmError: the checkpoint or the calibration set cannot be used, the output folder holds
            something else, or the exported graphs would not do what they are for.
    """
    check_replaceable(output_folder, WEIGHTS)
    trainee = prepare(load_checkpoint(checkpoint_path))
    exported = exported_blocks(trainee.checkpoint.most_layers, blocks)
    frames = CalibrationSet(calib_folder)
    fold_error = check_folding(trainee, frames[0])
    trainee, int8_trunk = calibrate_trunk(trainee, frames, watch)
    calibration = calibrate(trainee, frames, SEED, watch, epochs, calibrator, activation_bits)
    int8_sgms = {
        k: quantize_sgm(sgm, calibration.ranges[k], activation_bits)
        for k, sgm in trainee.sgms.items()
    }
    fidelity = measure(trainee, int8_sgms, frames, SEED, watch, epochs)
    graphs = build_graphs(trainee, int8_sgms, int8_trunk, exported)
    for name, model in graphs.items():
        refuse_float_products(name, model)
    files, sgms = bundle_files(graphs, int8_sgms, trainee.sgms)
    files[DISTRACTORS] = distractor_file(SHEET_SEED)
    layers = {
        k: LayerReport(fidelity[k], calibration.ranges[k], sgm, int8_sgms[k])
        for k, sgm in trainee.sgms.items()
    }
    size = sum(len(data) for data in files.values())
    report = ExportReport(str(output_folder), layers, calibration, fold_error, size)
    description = describe(trainee, exported, files) | {"sgms": sgms}
    files["README.md"] = model_card(report, provenance(checkpoint_path, trainee, frames)).encode()
    with new_folder(output_folder, WEIGHTS) as new:
        for name, data in files.items():
            (new / name).write_bytes(data)
        add_peaks(Bundle(new, description), exported, watch)
        text = json.dumps(description, indent=1, sort_keys=True) + "\n"
        (new / MANIFEST).write_text(text, encoding="utf-8")
    return report


def add_peaks(bundle: Bundle, blocks: Sequence[Blocks], watch: Watch) -> None:
    """Say in the manifest how many bytes of activations each training step holds at once."""
    steps = {
        step_file(precision, optimizer, one): one
        for one in every_block(bundle.most_layers, blocks)
        for precision in PRECISIONS
        for optimizer in optimizers_of(one)
    }
    for done, (name, one) in enumerate(steps.items(), start=1):
        peak = graph_memory(bundle, name, one, BATCH).peak
        bundle.manifest["files"][name]["peak_activation_bytes"] = peak
        watch("memory", done, len(steps))


def every_block(most_layers: int, blocks: Sequence[Blocks]) -> list[Blocks]:
    """Those with SGMs, and all layers as one block for every number of them."""
    return list(dict.fromkeys([*blocks, *map(one_block, range(1, most_layers + 1))]))


def provenance(path: Path, trainee: Trainee, frames: CalibrationSet) -> Provenance:
    """What a bundle is made from: a checkpoint's file and a calibration set."""
    return Provenance(
        path.name,
        sha256(path.read_bytes()),
        trainee.checkpoint.card,
        len(frames),
        sha256(frames.manifest_bytes),
    )


@torch.no_grad()
def check_folding(trainee: Trainee, demonstration: Demonstration) -> float:
    """Largest |difference| that folding makes to raw outputs and gradients, on a frame's crops.

    Raises QsgmError where it is more than rounding.
    """
    height, width = demonstration.image.shape[:2]
    rng = np.random.default_rng(SEED)
    plan = plan_crops((height, width), demonstration.center_px, rng, FOLD_CROPS)
    crops = torch.from_numpy(cut_crops(demonstration.image, plan))
    net, sgms = trainee.checkpoint.net, trainee.checkpoint.sgms
    error = net_fold_error(net, trainee.net, crops)
    refuse_large_error("the network", error, run_folded(trainee.net, crops))
    errors, labels = [error], torch.from_numpy(label_crops(plan))
    for layer, sgm in trainee.sgms.items():
        activation = net.between(normalize(crops), 1, layer)
        error = sgm_fold_error(sgms[layer], sgm, activation, labels)
        gradient = run_folded_sgm(sgm, activation, labels)
        refuse_large_error(f"the SGM behind layer {layer}", error, gradient)
        errors.append(error)
    return max(errors)


def refuse_large_error(what: str, error: float, outputs: torch.Tensor) -> None:
    """Raise QsgmError unless `error` is small beside the outputs (NaN is not)."""
    scale = float(outputs.abs().max())
    if not error <= LARGEST_FOLD_ERROR * scale:
        raise QsgmError(
            f"folding batchnorm changes {what} by up to {error:g}, at outputs up to {scale:g}:"
            f" expected less than {LARGEST_FOLD_ERROR:g} of it; its batchnorm statistics are"
            " extreme, pretrain again"
        )


def exported_blocks(most_layers: int, more: Sequence[Blocks]) -> list[Blocks]:
    """What the bundle can tune with SGMs; raises QsgmError where that is not possible.

    First every number of layers, each layer on its own, then the groups.
    """
    for blocks in more:
        if len(blocks.layers) > most_layers or not blocks.sgm_layers:
            raise QsgmError(
                f"cannot export steps for the blocks {blocks}: the checkpoint has SGMs for "
                f"{most_layers} layers at most, and one has to stand behind a block"
            )
    grouped = [blocks for blocks in map(parse_blocks, GROUPED) if len(blocks.layers) <= most_layers]
    singles = [single_layers(tuned) for tuned in range(1, most_layers + 1)]
    return list(dict.fromkeys([*singles, *grouped, *more]))


def calibrate_trunk(
    trainee: Trainee, frames: CalibrationSet, watch: Watch
) -> tuple[Trainee, dict[int, QuantizedLayer]]:
    """The same with steps for u8 features, and its layers that can be frozen in int8."""
    ranges = observe_trunk(trainee.net, frames, SEED, watch)
    net = replace(trainee.net, feature_steps=feature_steps(ranges))
    return replace(trainee, net=net), quantize_trunk(net, ranges)


def build_graphs(
    trainee: Trainee,
    int8_sgms: Mapping[int, QuantizedSgm],
    int8_trunk: Mapping[int, QuantizedLayer],
    blocks: Sequence[Blocks],
) -> dict[str, ModelProto]:
    """Every graph of a bundle, by file name."""
    net, loss, most = trainee.net, trainee.checkpoint.loss, trainee.checkpoint.most_layers
    graphs = {NETWORK: network_model(net, loss.encoding)}
    for tuned in range(1, most + 1):
        graphs |= build_trunks(net, int8_trunk, tuned)
        graphs[head_file(tuned)] = head_model(net, tuned, loss.encoding)
        if tuned > 1:
            graphs[probe_file(tuned)] = probe_model(net, tuned, trainee.sgms, int8_sgms, loss)
    for one in every_block(most, blocks):
        graphs |= build_steps(trainee, int8_sgms, one)
    return graphs


def build_trunks(
    net: FoldedNet, int8_trunk: Mapping[int, QuantizedLayer], tuned: int
) -> dict[str, ModelProto]:
    """The frozen layers when the last `tuned` are tuned; if none are, there is one precision."""
    last_frozen = LAYERS - tuned
    trunks = {trunk_file("float", tuned): trunk_model(net, last_frozen)}
    if last_frozen > 0:
        trunks[trunk_file("int8", tuned)] = int8_trunk_model(net, int8_trunk, last_frozen)
    return trunks


def build_steps(
    trainee: Trainee, int8_sgms: Mapping[int, QuantizedSgm], blocks: Blocks
) -> dict[str, ModelProto]:
    """The training steps of these blocks; a single one has no SGM in it, and one precision."""
    net, loss = trainee.net, trainee.checkpoint.loss
    variants: dict[Precision, Mapping[int, AnySgm]] = {"int8": int8_sgms, "float": trainee.sgms}
    # Meta-trained with SGD and SGMs: neither Adam nor backpropagation uses it.
    bent = {"sgd": trainee.checkpoint.curvatures if blocks.sgm_layers else FLAT, "adam": FLAT}
    return {
        step_file(precision, name, blocks): step_model(
            net, blocks, variants[precision], loss, OPTIMIZERS[name], bent[name]
        )
        for precision in (PRECISIONS if blocks.sgm_layers else ("float",))
        for name in optimizers_of(blocks)
    }


def optimizers_of(blocks: Blocks) -> list[OptimizerName]:
    """What these blocks are trained with: Adam on each layer on its own, or on all as one."""
    tuned = len(blocks.layers)
    return [*OPTIMIZERS] if blocks in (single_layers(tuned), one_block(tuned)) else ["sgd"]


def bundle_files(
    graphs: Mapping[str, ModelProto],
    int8_sgms: Mapping[int, QuantizedSgm],
    float_sgms: Mapping[int, FoldedSgm],
) -> tuple[dict[str, bytes], dict[str, Any]]:
    """Every file of a bundle but its manifest, and what that says of the SGMs.

    Constants lie in one file beside the graphs, which are changed, or in the network's. That one is
    left whole: a tuned object is a copy of it. The device reads the float SGMs when it calibrates
    anew.
    """
    network = graphs[NETWORK].SerializeToString()
    shared = SharedConstants(WEIGHTS, constants_elsewhere(NETWORK, network))
    sgms = {
        str(layer): {
            "bits": int8_sgms[layer].bits,
            "convolutions": [
                {"weight": shared.add_array(conv.weight), "bias": shared.add_array(conv.bias)}
                for conv in sgm.convs
            ],
        }
        for layer, sgm in float_sgms.items()
    }
    shared.take_from(model for name, model in graphs.items() if name != NETWORK)
    files = {name: model.SerializeToString() for name, model in graphs.items()}
    return files | {NETWORK: network, WEIGHTS: shared.data}, sgms


def describe(
    trainee: Trainee, blocks: Sequence[Blocks], files: Mapping[str, bytes]
) -> dict[str, Any]:
    """The manifest that :mod:`qsgm.bundle` reads."""
    loss = trainee.checkpoint.loss
    decision = trainee.checkpoint.decision
    return {
        "format": FORMAT,
        "version": VERSION,
        "encoding": loss.encoding,
        "label_smoothing": loss.label_smoothing,
        "most_layers": trainee.checkpoint.most_layers,
        "trunk": TRUNK,
        "blocks": [str(one) for one in blocks],
        "files": {
            name: {"sha256": sha256(data), "bytes": len(data)} for name, data in files.items()
        },
        "initializers": places(trainee, files[NETWORK]),
        "recipes": recipes(trainee.checkpoint, blocks),
        **({} if decision is None else {"decision": decision.to_json()}),
    }


def places(trainee: Trainee, network: bytes) -> dict[str, dict[str, Any]]:
    """Where the weights and biases that can be tuned lie in the network's file."""
    offsets = initializer_offsets(network)
    found = {}
    for number in tuned_layers(trainee.checkpoint.most_layers):
        layer = trainee.net.layers[number - 1]
        for name, array in ((f"weight{number}", layer.weight), (f"bias{number}", layer.bias)):
            found[name] = {"offset": offsets[name][0], "shape": list(array.shape)}
    return found


def recipes(checkpoint: Checkpoint, blocks: Sequence[Blocks]) -> dict[str, Any]:
    """Default optimizer and rates of both methods, by blocks."""
    sgm = {
        "sgd": {str(one): list(sgm_rates(checkpoint, one)) for one in blocks},
        "adam": {
            str(one): [SGM_ADAM_RATE] * len(one.layers)
            for one in blocks
            if "adam" in optimizers_of(one)
        },
    }
    whole = [one_block(tuned) for tuned in range(1, checkpoint.most_layers + 1)]
    bp = {
        name: {str(one): [rate] * len(one.layers) for one in whole}
        for name, rate in BACKPROP_RATES.items()
    }
    gains = {
        str(one): checkpoint.short_gain if len(one.layers) >= MAML_LAYERS else 1.0 for one in blocks
    }
    return {
        "sgm": {"optimizer": "sgd", "rates": sgm, "short_gains": gains},
        "bp": {"optimizer": "adam", "rates": bp},
    }


def sgm_rates(checkpoint: Checkpoint, blocks: Blocks) -> tuple[float, ...]:
    """The checkpoint's for these blocks, else those for as many layers on their own."""
    single = checkpoint.rates[str(single_layers(len(blocks.layers)))]
    return checkpoint.rates.get(str(blocks), single)


def sha256(data: bytes) -> str:
    """As hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()
