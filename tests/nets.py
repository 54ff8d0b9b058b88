"""Networks that nobody trained, for tests that ask whether two ways of computing them agree."""

import torch
from toy_task import ToyTask

from qsgm.grasp.network import GRASPNET
from qsgm.train.model.fold import folded_start
from qsgm.train.model.net import ConvNet
from qsgm.train.pretraining.rates import Start
from qsgm.train.pretraining.tasks import TaskSet, draw_tasks


def random_net(seed: int) -> ConvNet:
    """Random weights, and batchnorms that are far from the identity."""
    torch.manual_seed(seed)
    net = ConvNet(GRASPNET)
    for layer in net.layers:
        if layer.norm is not None:
            layer.norm.running_mean.normal_()
            layer.norm.running_var.uniform_(0.3, 3.0)
            torch.nn.init.uniform_(layer.norm.weight, 0.5, 2.0)
            torch.nn.init.normal_(layer.norm.bias)
    return net.eval()


def toy_start() -> Start:
    """The last two layers of a network for the toy task."""
    torch.manual_seed(0)
    return folded_start(ConvNet(ToyTask().network).eval(), 2)


def toy_tasks(count: int) -> TaskSet:
    """Toy lessons as those two layers see them, 80 samples each."""
    task = ToyTask()
    torch.manual_seed(0)
    net = ConvNet(task.network).eval()
    return draw_tasks(net, task, count, 80, 1, lambda: None, last_frozen=task.network.depth - 2)
