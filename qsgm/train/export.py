"""`qsgm fold-and-quantize`: from `sgm.pt` and a calibration set to the bundle that a device runs.

Fold, calibrate, quantize, build every graph, look whether ONNX Runtime makes integer operators of
the int8 ones, and write the lot with a manifest and a model card. The same checkpoint and the
same frames give the same bytes.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from onnx import ModelProto

from qsgm.bundle import (
    FORMAT,
    MANIFEST,
    NETWORK,
    VERSION,
    OptimizerName,
    Precision,
    head_file,
    probe_file,
    step_file,
    trunk_file,
    tuned_layers,
)
from qsgm.crops import cut_crops, label_crops, plan_crops
from qsgm.errors import QsgmError
from qsgm.files import check_replaceable, new_folder
from qsgm.train.calibrate import (
    EPOCHS,
    MOST_LAYERS,
    CalibrationSet,
    Demonstration,
    Trainee,
    Watch,
    calibrate,
    measure,
    prepare,
)
from qsgm.train.checkpoint import load_checkpoint
from qsgm.train.export_report import ExportReport, LayerReport, Provenance, model_card
from qsgm.train.fold import net_fold_error, run_folded, run_folded_sgm, sgm_fold_error
from qsgm.train.graphs.inspection import refuse_float_products
from qsgm.train.graphs.optimizers import Adam, Optimizer, Sgd
from qsgm.train.graphs.probe import head_model, probe_model
from qsgm.train.graphs.step import AnySgm, backprop_step_model, step_model
from qsgm.train.graphs.trunk import initializer_offsets, network_model, trunk_model
from qsgm.train.graspnet import LAYERS, normalize
from qsgm.train.quantize import QuantizedSgm, quantize_sgm

SEED = 0
# No other folder that qsgm writes holds a file of this name; `manifest.json` is in two kinds.
MARKER = trunk_file(1)
OPTIMIZERS: dict[OptimizerName, Optimizer] = {"sgd": Sgd(), "adam": Adam()}
TUNED = range(1, MOST_LAYERS + 1)
# Folding moves rounding errors about, no more: larger than this, it went wrong.
LARGEST_FOLD_ERROR = 1e-4  # relative to the largest output
FOLD_CROPS = 64
# SGD's rates for the SGMs are meta-trained; these are the usual ones, for every layer.
BACKPROP_RATES = {"sgd": 1e-2, "adam": 1e-3}
SGM_ADAM_RATE = 3e-4


def fold_and_quantize(
    checkpoint_path: Path,
    calib_folder: Path,
    output_folder: Path,
    watch: Watch,
    epochs: int = EPOCHS,
) -> ExportReport:
    """Export a checkpoint as a bundle.

    Args:
        checkpoint_path: `sgm.pt`.
        calib_folder: a calibration set, see :mod:`qsgm.train.draw_calibration`.
        output_folder: absent, empty, or an earlier bundle.
        watch: told about progress.
        epochs: length of each fine-tuning run that ranges are taken along.

    Raises:
        QsgmError: the checkpoint or the calibration set cannot be used, the output folder holds
            something else, or the exported graphs would not do what they are for.
    """
    check_replaceable(output_folder, MARKER)
    trainee = prepare(load_checkpoint(checkpoint_path))
    frames = CalibrationSet(calib_folder)
    fold_error = check_folding(trainee, frames[0])
    ranges = calibrate(trainee, frames, SEED, watch, epochs)
    int8_sgms = {k: quantize_sgm(sgm, ranges[k]) for k, sgm in trainee.sgms.items()}
    fidelity = measure(trainee, int8_sgms, frames, SEED, watch, epochs)
    graphs = build_graphs(trainee, int8_sgms)
    for name, model in graphs.items():
        refuse_float_products(name, model)
    files = {name: model.SerializeToString() for name, model in graphs.items()}
    report = ExportReport(
        str(output_folder),
        {
            k: LayerReport(fidelity[k], ranges[k], sgm, int8_sgms[k])
            for k, sgm in trainee.sgms.items()
        },
        fold_error,
        sum(len(data) for data in files.values()),
    )
    provenance = Provenance(
        checkpoint_path.name,
        sha256(checkpoint_path.read_bytes()),
        trainee.checkpoint.card,
        len(frames),
        sha256(frames.manifest_bytes),
    )
    with new_folder(output_folder, MARKER) as new:
        for name, data in files.items():
            (new / name).write_bytes(data)
        manifest = json.dumps(describe(trainee, files), indent=1, sort_keys=True)
        (new / MANIFEST).write_text(manifest + "\n")
        (new / "README.md").write_text(model_card(report, provenance))
    return report


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


def build_graphs(trainee: Trainee, int8_sgms: Mapping[int, QuantizedSgm]) -> dict[str, ModelProto]:
    """Every graph of a bundle, by file name."""
    net, loss = trainee.net, trainee.checkpoint.loss
    graphs = {NETWORK: network_model(net, loss.encoding)}
    for tuned in TUNED:
        graphs[trunk_file(tuned)] = trunk_model(net, LAYERS - tuned)
        graphs[head_file(tuned)] = head_model(net, tuned, loss.encoding)
        graphs |= build_steps(trainee, int8_sgms, tuned)
        if tuned > 1:
            graphs[probe_file(tuned)] = probe_model(net, tuned, trainee.sgms, int8_sgms, loss)
    return graphs


def build_steps(
    trainee: Trainee, int8_sgms: Mapping[int, QuantizedSgm], tuned: int
) -> dict[str, ModelProto]:
    """The training steps of the last `tuned` layers; a single one has no SGM in it."""
    net, loss = trainee.net, trainee.checkpoint.loss
    variants: dict[Precision, Mapping[int, AnySgm]] = {"int8": int8_sgms, "float": trainee.sgms}
    steps = {}
    for name, optimizer in OPTIMIZERS.items():
        steps[step_file("bp", "float", name, tuned)] = backprop_step_model(
            net, tuned, loss, optimizer
        )
        for precision, sgms in variants.items() if tuned > 1 else ():
            steps[step_file("sgm", precision, name, tuned)] = step_model(
                net, tuned, sgms, loss, optimizer
            )
    return steps


def describe(trainee: Trainee, files: Mapping[str, bytes]) -> dict[str, Any]:
    """The manifest that :mod:`qsgm.bundle` reads."""
    loss = trainee.checkpoint.loss
    return {
        "format": FORMAT,
        "version": VERSION,
        "encoding": loss.encoding,
        "label_smoothing": loss.label_smoothing,
        "most_layers": MOST_LAYERS,
        "files": {
            name: {"sha256": sha256(data), "bytes": len(data)} for name, data in files.items()
        },
        "initializers": places(trainee, files[NETWORK]),
        "recipes": recipes(trainee.checkpoint.rates),
    }


def places(trainee: Trainee, network: bytes) -> dict[str, dict[str, Any]]:
    """Where the weights and biases that can be tuned lie in the network's file."""
    offsets = initializer_offsets(network)
    found = {}
    for number in tuned_layers(MOST_LAYERS):
        layer = trainee.net.layers[number - 1]
        for name, array in ((f"weight{number}", layer.weight), (f"bias{number}", layer.bias)):
            found[name] = {"offset": offsets[name][0], "shape": list(array.shape)}
    return found


def recipes(sgm_rates: Mapping[int, tuple[float, ...]]) -> dict[str, Any]:
    """Default optimizer and rates of both methods, by number of tuned layers."""
    sgm = {
        "sgd": {str(tuned): list(sgm_rates[tuned]) for tuned in TUNED},
        "adam": {str(tuned): [SGM_ADAM_RATE] * tuned for tuned in TUNED},
    }
    bp = {
        name: {str(tuned): [rate] * tuned for tuned in TUNED}
        for name, rate in BACKPROP_RATES.items()
    }
    return {"sgm": {"optimizer": "sgd", "rates": sgm}, "bp": {"optimizer": "adam", "rates": bp}}


def sha256(data: bytes) -> str:
    """As hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()
