"""A bundle of random weights, made by the exporter; run with a folder, this writes it there."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import nn
from toys import draw_frame, draw_things

from qsgm.blocks import single_layers
from qsgm.grasp.crops import cut_crops, plan_crops
from qsgm.grasp.distractors import FILE as DISTRACTORS
from qsgm.grasp.network import GRASPNET
from qsgm.grasp.source import Demonstration, crop_source
from qsgm.manifest import MANIFEST
from qsgm.sgm.float import FoldedSgm, float_trace
from qsgm.sgm.int8 import QuantizedSgm, SgmRanges, quantize_sgm
from qsgm.task import label_span, task_record
from qsgm.train.checkpoint import Checkpoint
from qsgm.train.export import build_graphs, bundle_files, describe, exported_blocks
from qsgm.train.grasp.draw_distractors import encode_sheet
from qsgm.train.grasp.task import DrawnGrasping, shipped_things
from qsgm.train.model.net import ConvNet, as_seen
from qsgm.train.model.sgm import Sgm
from qsgm.train.quantization.calibration_runs import prepare
from qsgm.train.quantization.trunk import feature_steps, quantize_trunk
from qsgm.train.quantization.trunk_ranges import observe_samples

MOST_LAYERS = 6
RATES = (1e-4, 1e-4, 1e-3, 0.002, 0.005, 0.02)


def write_bundle(folder: Path) -> None:
    """What the exporter makes of a random checkpoint; ranges are made up."""
    trainee = prepare(random_checkpoint())
    shown, rng = Demonstration(draw_frame()[0], (320, 240)), np.random.default_rng(1)
    crops = crop_source([shown], shipped_things(), rng, 200).cut(np.arange(200))
    ranges = dict(observe_samples(trainee.net, crops))
    trainee = replace(trainee, net=replace(trainee.net, feature_steps=feature_steps(ranges)))
    int8_sgms = {layer: _quantized(sgm) for layer, sgm in trainee.sgms.items()}
    exported = exported_blocks(GRASPNET, MOST_LAYERS, ())
    graphs = build_graphs(trainee, int8_sgms, quantize_trunk(trainee.net, ranges), exported)
    files, sgms = bundle_files(graphs, int8_sgms, trainee.sgms)
    files[DISTRACTORS] = encode_sheet(draw_things())
    for file, data in files.items():
        (folder / file).write_bytes(data)
    (folder / MANIFEST).write_text(describe(trainee, exported, files, sgms).text())


def random_checkpoint() -> Checkpoint:
    """Nothing in it was trained; rates are those at which nothing diverges."""
    torch.manual_seed(0)
    net = _random_net()
    sgms = {layer: _random_sgm(layer) for layer in range(1, MOST_LAYERS)}
    rates = {
        str(single_layers(GRASPNET.last(tuned))): RATES[-tuned:]
        for tuned in range(1, MOST_LAYERS + 1)
    }
    return Checkpoint(task_record(DrawnGrasping()), net, sgms, {}, rates, {})


def _random_net() -> ConvNet:
    """Random weights; batchnorm has seen crops, so that every layer's outputs vary."""
    net = ConvNet(GRASPNET)
    frame = draw_frame()[0]
    plan = plan_crops((480, 640), (320, 240), np.random.default_rng(0), 64)
    with torch.no_grad():
        for _ in range(20):
            net(as_seen(GRASPNET, torch.from_numpy(cut_crops(frame, plan))))
    return net.eval()


def _random_sgm(layer: int) -> Sgm:
    """Gradients of about the size of true ones: untrained SGMs would run away."""
    sgm = Sgm(GRASPNET, layer, (12,))
    last = sgm.convs[-1]
    assert isinstance(last, nn.Conv2d)
    nn.init.normal_(last.weight, std=0.01)
    nn.init.zeros_(last.bias)
    return sgm.eval()


def _quantized(sgm: FoldedSgm) -> QuantizedSgm:
    """Ranges of activations up to 10, any label, and what the hidden layer makes of those."""
    channels, span = GRASPNET.layer(sgm.layer).out, label_span(DrawnGrasping().heads)
    low = np.concatenate([np.zeros(channels, np.float32), span[0]])
    high = np.concatenate([np.full(channels, 10, np.float32), span[1]])
    shape = (20, GRASPNET.positions_after(sgm.layer), len(low))
    inputs = np.random.default_rng(0).uniform(low, high, shape).astype(np.float32)
    _, (hidden,) = float_trace(sgm, inputs)
    return quantize_sgm(sgm, SgmRanges(low, high, (hidden.max(axis=(0, 1)) + 1,)))


if __name__ == "__main__":
    Path(sys.argv[1]).mkdir()
    write_bundle(Path(sys.argv[1]))
