"""Networks that nobody trained, for tests that ask whether two ways of computing them agree."""

import torch

from qsgm.grasp.network import GRASPNET
from qsgm.train.model.net import ConvNet


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
