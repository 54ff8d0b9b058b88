"""Pretraining on all objects but one (paper sections 3.3, 4.1 and 4.2).

1. The network, by backpropagation: Adam at 1e-3, batches of 32 from all objects. Baselines without
   SGMs are fine-tuned from here.
2. Network and SGMs: the SGMs update the last three layers on batches of every object at once, and
   follow the true gradients by l2; SGD at 1e-1 for both. The paper calls this step MAML and says
   that the model "is trained on different tasks individually, while minimizing the summed error on
   all tasks", not how many steps each; here it is one, of all objects together.
   Two more sets of SGMs learn on the way and drive nothing: one by l1, one without the label.
3. The same a while longer with four layers, for what SGMs behind more layers do.
"""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from qsgm.grasp.network import GRASPNET
from qsgm.schedule import BATCH, MOMENTUM
from qsgm.train.heads import mean_loss
from qsgm.train.model.net import ConvNet, as_seen, maps_of
from qsgm.train.model.sgm import Sgm
from qsgm.train.paper.baselines.static_sgms import LabelFreeSgm
from qsgm.train.paper.driven import (
    RATE,
    Driver,
    FollowingSgms,
    cut_pass,
    driven_step,
    last_layers,
)
from qsgm.train.paper.objects import PAPER_TASK, ObjectCrops
from qsgm.train.pretraining.tasks import features_of

ADAM_RATE = 1e-3  # paper section 4.1
Sgms = Mapping[int, Sgm]


@dataclass(frozen=True)
class PretrainingSizes:
    """Steps of each stage, and how many crops of every object a step of the later two sees."""

    network_steps: int = 1000
    sgm_steps: int = 3000
    four_layer_steps: int = 500
    crops_per_object: int = 32


@dataclass(frozen=True)
class Pretrained:
    """What fine-tuning starts from."""

    network: ConvNet  # after stage 1
    driven: ConvNet  # after stage 2, with these SGMs behind its layers 4 and 5
    sgms: Sgms
    l1_sgms: Sgms
    label_free_sgms: Sgms
    four_layers: ConvNet  # after stage 3, with these behind layers 3 to 5
    four_layer_sgms: Sgms


def pretrain_without(
    held_out: str,
    objects: Mapping[str, ObjectCrops],
    sizes: PretrainingSizes,
    seed: int,
    after_step: Callable[[], None],
) -> Pretrained:
    """All three stages on every object but `held_out`; each sees learning crops only."""
    others = [crops for letter, crops in objects.items() if letter != held_out]
    torch.manual_seed(seed)
    network = pretrain_network(others, sizes.network_steps, after_step)
    driven = deepcopy(network)
    sgms = {layer: Sgm(GRASPNET, layer) for layer in (4, 5)}
    l1_sgms = {layer: Sgm(GRASPNET, layer) for layer in (4, 5)}
    label_free: dict[int, Sgm] = {layer: LabelFreeSgm(GRASPNET, layer) for layer in (4, 5)}
    watching = [FollowingSgms(l1_sgms, F.l1_loss), FollowingSgms(label_free)]
    count = sizes.crops_per_object
    drive(driven, 3, FollowingSgms(sgms), watching, others, sizes.sgm_steps, count, after_step)
    four, four_sgms = deepcopy(driven), {3: Sgm(GRASPNET, 3), **deepcopy(sgms)}
    steps = sizes.four_layer_steps
    drive(four, 4, FollowingSgms(four_sgms), [], others, steps, count, after_step)
    return Pretrained(network, driven, sgms, l1_sgms, label_free, four, four_sgms)


def pretrain_network(
    objects: Sequence[ObjectCrops], steps: int, after_step: Callable[[], None]
) -> ConvNet:
    """Stage 1; torch's global generator draws weights and batches."""
    crops = torch.cat([each.crops[: each.support] for each in objects])
    labels = torch.cat([each.labels[: each.support] for each in objects])
    net = ConvNet(GRASPNET).train()
    optimizer = torch.optim.Adam(net.parameters(), ADAM_RATE)
    for _ in range(steps):
        rows = torch.randint(len(labels), (BATCH,))
        raw = net(as_seen(GRASPNET, crops[rows]))[:, :, 0, 0]
        loss = mean_loss(PAPER_TASK.heads, raw, labels[rows])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        after_step()
    return net.eval()


def drive(
    net: ConvNet,
    tuned: int,
    driver: Driver,
    watching: Sequence[Driver],
    objects: Sequence[ObjectCrops],
    steps: int,
    crops_per_object: int,
    after_step: Callable[[], None],
) -> None:
    """Stages 2 and 3: train the last `tuned` layers of `net` in place, by the driver's gradients.

    Args:
        net: in eval mode; so it is in the end.
        tuned: how many layers.
        driver: whose gradients these take; it may learn.
        watching: they see the same and may learn from it, their gradients are not taken.
        objects: all take part in every step.
        steps: how many.
        crops_per_object: in a step.
        after_step: told of each.
    """
    maps = [_maps(net, each, net.network.depth - tuned) for each in objects]
    layers = last_layers(net, tuned)
    parameters = [p for layer in layers.values() for p in layer.parameters()]
    optimizer = torch.optim.SGD(parameters, RATE, momentum=MOMENTUM)
    for _ in range(steps):
        rows = [torch.randint(len(x), (crops_per_object,)) for x in maps]
        x = torch.cat([x[row] for x, row in zip(maps, rows, strict=True)])
        labels = torch.cat([o.labels[row] for o, row in zip(objects, rows, strict=True)])
        seen = cut_pass(layers, x, labels, PAPER_TASK.heads)
        for other in watching:
            other.gradients(seen)
        driven_step(layers, seen, driver, optimizer)
        after_step()
    net.eval()


def _maps(net: ConvNet, crops: ObjectCrops, last_frozen: int) -> Tensor:
    """What the frozen layers make of the learning crops: (N, C, H, W)."""
    pixels = crops.crops[: crops.support].numpy()
    features = features_of(net, pixels, last_frozen)
    return maps_of(features, net.network.before(last_frozen + 1)).contiguous()
