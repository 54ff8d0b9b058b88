"""`qsgm fold-and-quantize`: a checkpoint becomes a bundle.

Fold batchnorm, take ranges along fine-tuning runs on the calibration set, quantize, build every
graph, and write them with the manifest that :mod:`qsgm.bundle` reads.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from onnx import ModelProto

from qsgm.blocks import Blocks, one_block, parse_blocks, single_layers
from qsgm.bundle import Bundle
from qsgm.errors import QsgmError
from qsgm.files import check_replaceable, new_folder, sha256
from qsgm.manifest import (
    MANIFEST,
    NETWORK,
    PRECISIONS,
    WEIGHTS,
    FileEntry,
    Manifest,
    Method,
    OptimizerName,
    Place,
    Precision,
    Recipe,
    Recipes,
    SgmEntry,
    head_file,
    probe_file,
    step_file,
    trunk_file,
)
from qsgm.network import Network
from qsgm.progress import Progress
from qsgm.schedule import Gains
from qsgm.sgm.float import FoldedSgm
from qsgm.sgm.int8 import ActivationBits, QuantizedSgm, quantize_sgm
from qsgm.train.checkpoint import Checkpoint, load_checkpoint
from qsgm.train.export_report import ExportReport, GroupRow, LayerReport, model_card
from qsgm.train.graphs.inspection import refuse_float_products
from qsgm.train.graphs.memory import with_peaks
from qsgm.train.graphs.optimizers import OPTIMIZERS, Optimizer
from qsgm.train.graphs.probe import head_model, probe_model
from qsgm.train.graphs.sharing import SharedConstants, constants_elsewhere, shared_sgm
from qsgm.train.graphs.step import AnySgm, step_model
from qsgm.train.graphs.trunk import (
    initializer_offsets,
    int8_trunk_model,
    network_model,
    trunk_model,
)
from qsgm.train.grouping import SgmCost, cost_of_blocks, sgm_cost, usual_blocks
from qsgm.train.heads import activate
from qsgm.train.model.arrays import FLAT_ARRAYS, CurvatureArrays, FoldedNet
from qsgm.train.model.fold import net_fold_error, run_folded, run_folded_sgm, sgm_fold_error
from qsgm.train.model.net import as_seen
from qsgm.train.processes import in_processes
from qsgm.train.quantization.calibrate import AUTO, calibrate
from qsgm.train.quantization.calibration_runs import EPOCHS, CalibrationRuns, Trainee, prepare
from qsgm.train.quantization.lessons import Lessons
from qsgm.train.quantization.sgm_fidelity import measure
from qsgm.train.quantization.trunk import QuantizedLayer, feature_steps, quantize_trunk
from qsgm.train.quantization.trunk_ranges import observe_trunk

SEED = 0
# Of the frozen layers, unless the user says otherwise: in int8 they take longer (docs/cost.md).
TRUNK: Precision = "float"
# Folding moves rounding errors about, no more: larger than this, it went wrong.
LARGEST_FOLD_ERROR = 1e-4  # relative to the largest output
FOLD_SAMPLES = 64
# As many as were meta-trained together, unless the checkpoint's curvatures say otherwise.
MAML_LAYERS = 3


@dataclass(frozen=True)
class ExportOptions:
    """What a bundle is to hold, and how it is calibrated."""

    epochs: int = EPOCHS  # length of each fine-tuning run that ranges are taken along
    blocks: tuple[Blocks, ...] = ()  # to be tuned beside each layer on its own and :func:`grouped`
    calibrator: str = AUTO  # see :func:`qsgm.train.quantization.calibrate.calibrate`
    activation_bits: ActivationBits = 16  # of the int8 SGMs' inputs, in one u8 plane or two
    # Groups in which SGMs pay in the place of :func:`grouped`; devices tune those as is usual.
    paying: bool = False
    # That go through the calibration set, one core each; how many they are changes no byte.
    processes: int = 1


def export_bundle(
    checkpoint_path: Path,
    lessons: Lessons,
    output_folder: Path,
    task_files: Mapping[str, bytes],
    watch: Progress,
    options: ExportOptions = ExportOptions(),
) -> ExportReport:
    """Export a checkpoint as a bundle.

    Args:
        checkpoint_path: `sgm.pt`.
        lessons: to calibrate on.
        output_folder: absent, empty, or an earlier bundle.
        task_files: what the task adds to a bundle, by name.
        watch: told about progress.
        options: what the bundle is to hold.

    Raises:
        QsgmError: the checkpoint or the lessons cannot be used, the output folder holds something
            else, or the exported graphs would not do what they are for.
    """
    check_replaceable(output_folder, WEIGHTS)
    trainee = prepare(load_checkpoint(checkpoint_path))
    most, bits = trainee.checkpoint.most_layers, options.activation_bits
    usual = paying_groups(trainee) if options.paying else {}
    groups = [*usual.values()] if options.paying else None
    exported = exported_blocks(trainee.network, most, options.blocks, groups)
    fold_error = check_folding(trainee, lessons)
    trainee, int8_trunk = calibrate_trunk(trainee, lessons, watch)
    runs = CalibrationRuns(trainee, lessons, options.epochs)
    with in_processes(options.processes) as in_turn:
        calibration = calibrate(runs, watch, options.calibrator, bits, in_turn)
        int8_sgms = {
            k: quantize_sgm(sgm, calibration.ranges[k], bits) for k, sgm in trainee.sgms.items()
        }
        runs = replace(runs, looks=calibration.looks)
        fidelity = measure(runs, int8_sgms, watch, in_turn)
    graphs = build_graphs(trainee, int8_sgms, int8_trunk, exported)
    for name, model in graphs.items():
        refuse_float_products(name, model)
    files, sgms = bundle_files(graphs, int8_sgms, trainee.sgms)
    files |= task_files
    layers = {
        k: LayerReport(fidelity[k], calibration.ranges[k], sgm, int8_sgms[k])
        for k, sgm in trainee.sgms.items()
    }
    size = sum(len(data) for data in files.values())
    report = ExportReport(str(output_folder), layers, calibration, fold_error, size)
    manifest = describe(trainee, exported, files, sgms)
    if usual:
        texts = {tuned: str(blocks) for tuned, blocks in usual.items()}
        manifest = replace(manifest, usual_blocks=texts)
    card = model_card(report, checkpoint_path, trainee.checkpoint, lessons, task_files)
    files["README.md"] = card.encode()
    with new_folder(output_folder, WEIGHTS) as new:
        for name, data in files.items():
            (new / name).write_bytes(data)
        steps = steps_of(trainee.network, most, exported)
        manifest = with_peaks(Bundle(new, manifest), steps, watch)
        (new / MANIFEST).write_text(manifest.text(), encoding="utf-8")
    return replace(report, groups=tuple(group_rows(trainee, usual, manifest)))


def paying_groups(trainee: Trainee) -> dict[int, Blocks]:
    """By how many layers are tuned, the groups in which SGMs pay."""
    checkpoint, sgms = trainee.checkpoint, sgm_costs(trainee)
    late = meta_trained(checkpoint)
    return usual_blocks(trainee.network, checkpoint.most_layers, sgms, late)


def sgm_costs(trainee: Trainee) -> dict[int, SgmCost]:
    """What every SGM costs, by layer."""
    return {
        k: sgm_cost(trainee.network, k, [conv.weight.shape for conv in sgm.convs])
        for k, sgm in trainee.sgms.items()
    }


def group_rows(
    trainee: Trainee, usual: Mapping[int, Blocks], manifest: Manifest
) -> Iterator[GroupRow]:
    """What the chosen groups cost beside each layer on its own and backpropagation."""
    network, sgms = trainee.network, sgm_costs(trainee)
    for blocks in usual.values():
        whole, singles = one_block(blocks.layers), single_layers(blocks.layers)
        every = (blocks, singles, whole)
        macs = [cost_of_blocks(network, one, sgms).macs for one in every]
        names = [step_file("float", "sgd", one) for one in every]
        peaks = [manifest.files[name].peak_activation_bytes or 0 for name in names]
        yield GroupRow(str(blocks), macs[0] / macs[2], macs[1] / macs[2], *peaks)


def steps_of(network: Network, most_layers: int, blocks: Sequence[Blocks]) -> dict[str, Blocks]:
    """Every training step's file, and its blocks."""
    return {
        step_file(precision, optimizer, one): one
        for one in every_block(network, most_layers, blocks)
        for precision in PRECISIONS
        for optimizer in optimizers_of(one)
    }


def every_block(network: Network, most_layers: int, blocks: Sequence[Blocks]) -> list[Blocks]:
    """Blocks with SGMs, and for every number of layers all of them as one block."""
    whole = (one_block(network.last(tuned)) for tuned in range(1, most_layers + 1))
    return list(dict.fromkeys([*blocks, *whole]))


@torch.no_grad()
def check_folding(trainee: Trainee, lessons: Lessons) -> float:
    """Largest |difference| that folding makes to raw outputs and gradients, on a lesson's samples.

    Raises QsgmError where it is more than rounding.
    """
    lesson = lessons.lesson(0, np.random.default_rng(SEED), FOLD_SAMPLES)
    samples = torch.from_numpy(lesson.cut(np.arange(FOLD_SAMPLES)))
    net, sgms = trainee.checkpoint.net, trainee.checkpoint.sgms
    error, raw = net_fold_error(net, trainee.net, samples), run_folded(trainee.net, samples)
    refuse_large_error("the network", error, raw)
    answers = activate(trainee.checkpoint.task.heads, raw[:, :, 0, 0]).numpy()
    errors, labels = [error], torch.from_numpy(lesson.labelled(answers).labels)
    for layer, sgm in trainee.sgms.items():
        activation = net.between(as_seen(net.network, samples), 1, layer)
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


def grouped(network: Network, most_layers: int) -> list[Blocks]:
    """Blocks exported beside each layer on its own, as far as there are layers for them.

    The last two layers as one; and earlier layers as one with the first of the last three.
    """
    depth = network.depth
    first = depth - MAML_LAYERS + 1
    blocks = [Blocks((range(first, first + 1), range(first + 1, depth + 1)))] if first > 0 else []
    for start in range(first - 1, 0, -1):
        singles = (range(k, k + 1) for k in range(first + 1, depth + 1))
        blocks.append(Blocks((range(start, first + 1), *singles)))
    return [one for one in blocks if len(one.layers) <= most_layers]


def exported_blocks(
    network: Network,
    most_layers: int,
    more: Sequence[Blocks],
    groups: Sequence[Blocks] | None = None,
) -> list[Blocks]:
    """What the bundle can tune with SGMs; raises QsgmError where that is not possible.

    First every number of layers, each layer on its own, then the groups, :func:`grouped` without.
    """
    for blocks in more:
        if len(blocks.layers) > most_layers or not blocks.sgm_layers:
            raise QsgmError(
                f"cannot export steps for the blocks {blocks}: the checkpoint has SGMs for "
                f"{most_layers} layers at most, and one has to stand behind a block"
            )
        parse_blocks(str(blocks), network.depth)
    singles = [single_layers(network.last(tuned)) for tuned in range(1, most_layers + 1)]
    groups = grouped(network, most_layers) if groups is None else groups
    return list(dict.fromkeys([*singles, *groups, *more]))


def calibrate_trunk(
    trainee: Trainee, lessons: Lessons, watch: Progress
) -> tuple[Trainee, dict[int, QuantizedLayer]]:
    """A trainee with steps for u8 features, and its layers that can be frozen in int8."""
    ranges = observe_trunk(trainee.net, lessons, SEED, watch)
    net = replace(trainee.net, feature_steps=feature_steps(ranges))
    return replace(trainee, net=net), quantize_trunk(net, ranges)


def build_graphs(
    trainee: Trainee,
    int8_sgms: Mapping[int, QuantizedSgm],
    int8_trunk: Mapping[int, QuantizedLayer],
    blocks: Sequence[Blocks],
) -> dict[str, ModelProto]:
    """Every graph of a bundle, by file name."""
    net, heads, most = trainee.net, trainee.checkpoint.task.heads, trainee.checkpoint.most_layers
    graphs = {NETWORK: network_model(net, heads)}
    for tuned in range(1, most + 1):
        graphs |= build_trunks(net, int8_trunk, tuned)
        graphs[head_file(tuned)] = head_model(net, tuned, heads)
        if tuned > 1:
            graphs[probe_file(tuned)] = probe_model(net, tuned, trainee.sgms, int8_sgms, heads)
    for one in every_block(net.network, most, blocks):
        graphs |= build_steps(trainee, int8_sgms, one)
    return graphs


def build_trunks(
    net: FoldedNet, int8_trunk: Mapping[int, QuantizedLayer], tuned: int
) -> dict[str, ModelProto]:
    """The frozen layers when the last `tuned` are tuned; if none are, there is one precision."""
    layers, last_frozen = net.network.last(tuned), net.network.depth - tuned
    trunks = {trunk_file("float", layers): trunk_model(net, last_frozen)}
    if last_frozen in int8_trunk:
        trunks[trunk_file("int8", layers)] = int8_trunk_model(net, int8_trunk, last_frozen)
    return trunks


def build_steps(
    trainee: Trainee, int8_sgms: Mapping[int, QuantizedSgm], blocks: Blocks
) -> dict[str, ModelProto]:
    """The training steps of these blocks; a single one has no SGM in it, and one precision."""
    net, heads = trainee.net, trainee.checkpoint.task.heads
    variants: dict[Precision, Mapping[int, AnySgm]] = {"int8": int8_sgms, "float": trainee.sgms}
    # Meta-trained with SGD and SGMs: neither Adam nor backpropagation uses it.
    bent = {k: one.arrays() for k, one in trainee.checkpoint.curvatures.items()}

    def curvatures(optimizer: Optimizer) -> Mapping[int, CurvatureArrays]:
        meta_trained = optimizer.sgm_rate is None and blocks.sgm_layers
        return bent if meta_trained else FLAT_ARRAYS

    return {
        step_file(precision, name, blocks): step_model(
            net, blocks, variants[precision], heads, OPTIMIZERS[name], curvatures(OPTIMIZERS[name])
        )
        for precision in (PRECISIONS if blocks.sgm_layers else ("float",))
        for name in optimizers_of(blocks)
    }


def optimizers_of(blocks: Blocks) -> list[OptimizerName]:
    """What these blocks are trained with: Adam on each layer on its own, or on all as one."""
    layers = blocks.layers
    return [*OPTIMIZERS] if blocks in (single_layers(layers), one_block(layers)) else ["sgd"]


def bundle_files(
    graphs: Mapping[str, ModelProto],
    int8_sgms: Mapping[int, QuantizedSgm],
    float_sgms: Mapping[int, FoldedSgm],
) -> tuple[dict[str, bytes], dict[int, SgmEntry]]:
    """Every graph's file and that of the constants, and where the SGMs lie in it.

    Constants lie in one file beside the graphs, which are changed, or in the network's. That one is
    left whole: a tuned object is a copy of it. The device reads the float SGMs when it calibrates
    anew.
    """
    network = graphs[NETWORK].SerializeToString()
    shared = SharedConstants(WEIGHTS, constants_elsewhere(NETWORK, network))
    sgms = {
        layer: shared_sgm(shared, sgm, int8_sgms[layer].bits) for layer, sgm in float_sgms.items()
    }
    shared.take_from(model for name, model in graphs.items() if name != NETWORK)
    files = {name: model.SerializeToString() for name, model in graphs.items()}
    return files | {NETWORK: network, WEIGHTS: shared.data}, sgms


def describe(
    trainee: Trainee,
    blocks: Sequence[Blocks],
    files: Mapping[str, bytes],
    sgms: Mapping[int, SgmEntry],
) -> Manifest:
    """The manifest of a bundle with these files."""
    checkpoint = trainee.checkpoint
    return Manifest(
        checkpoint.task,
        checkpoint.most_layers,
        TRUNK,
        tuple(str(one) for one in blocks),
        recipes(checkpoint, blocks),
        places(trainee, files[NETWORK]),
        sgms,
        {name: FileEntry(sha256(data)) for name, data in files.items()},
    )


def places(trainee: Trainee, network: bytes) -> dict[str, Place]:
    """Where the weights and biases that can be tuned lie in the network's file."""
    offsets = initializer_offsets(network)
    found = {}
    for number in trainee.network.last(trainee.checkpoint.most_layers):
        layer = trainee.net.layers[number - 1]
        for name, array in ((f"weight{number}", layer.weight), (f"bias{number}", layer.bias)):
            found[name] = Place(offsets[name][0], array.shape)
    return found


def recipes(checkpoint: Checkpoint, blocks: Sequence[Blocks]) -> dict[Method, Recipes]:
    """Default optimizer and rates of both methods, by blocks."""
    sgm: dict[OptimizerName, dict[str, Recipe]] = {
        name: {
            str(one): sgm_recipe(checkpoint, one, name)
            for one in blocks
            if name in optimizers_of(one)
        }
        for name in OPTIMIZERS
    }
    network = checkpoint.task.network
    whole = [one_block(network.last(tuned)) for tuned in range(1, checkpoint.most_layers + 1)]
    bp = {
        name: {str(one): (optimizer.rate,) * len(one.layers) for one in whole}
        for name, optimizer in OPTIMIZERS.items()
    }
    late = meta_trained(checkpoint)  # for which the gain of short runs was found
    gains = {str(one): checkpoint.short_gain if len(one.layers) >= late else 1.0 for one in blocks}
    usual = checkpoint.recipes.items()
    found = Recipes(
        "sgd",
        {name: {text: one.rates for text, one in some.items()} for name, some in sgm.items()},
        gains,
        gains_of(sgm),
        {text: some[0].optimizer for text, some in usual if some[0].optimizer != "sgd"},
    )
    return {"sgm": found, "bp": Recipes("adam", bp)}


def gains_of(
    recipes: Mapping[OptimizerName, Mapping[str, Recipe]],
) -> dict[OptimizerName, dict[str, Gains]]:
    """By optimizer and blocks, where they are known by length."""
    known = {
        name: {text: one.gains for text, one in some.items() if one.gains}
        for name, some in recipes.items()
    }
    return {name: some for name, some in known.items() if some}


def meta_trained(checkpoint: Checkpoint) -> int:
    """How many of the last layers were meta-trained."""
    return len(checkpoint.curvatures) or MAML_LAYERS


def sgm_recipe(checkpoint: Checkpoint, blocks: Blocks, name: OptimizerName) -> Recipe:
    """The checkpoint's for these blocks, else those for as many layers on their own.

    More layers than were meta-trained take the gains of those that were.
    """
    known = {
        (text, one.optimizer): one
        for text in checkpoint.recipes
        for one in checkpoint.recipes[text]
    }
    if (str(blocks), name) in known:
        return known[str(blocks), name]
    usual = OPTIMIZERS[name].sgm_rate
    if usual is not None:
        return Recipe(name, (usual,) * len(blocks.layers))
    late = str(single_layers(checkpoint.task.network.last(meta_trained(checkpoint))))
    single = checkpoint.rates[str(single_layers(blocks.layers))]
    gains = known[late, name].gains if (late, name) in known else ()
    return Recipe(name, checkpoint.rates.get(str(blocks), single), gains)
