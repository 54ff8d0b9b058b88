"""The tuned layers' start, out of the network and back."""

import copy

import torch
from nets import random_net

from qsgm.grasp.network import GRASPNET
from qsgm.grasp.task import GraspTask
from qsgm.train.heads import activate
from qsgm.train.model.fold import folded_start, write_back
from qsgm.train.model.local import outputs
from qsgm.train.pretraining.tasks import start_states


@torch.no_grad()
def test_the_folded_start_answers_as_the_network_does() -> None:
    net = random_net(0)
    maps = torch.rand(4, 16, 13, 13)
    features = maps.flatten(2).transpose(1, 2)[None]
    raw = outputs(GRASPNET, start_states(folded_start(net, 3), 1), features)[0]
    torch.testing.assert_close(raw, net.between(maps, 4, 6)[:, :, 0, 0], atol=1e-5, rtol=1e-5)


@torch.no_grad()
def test_what_is_written_back_folds_to_what_was_learnt() -> None:
    net = random_net(1)
    learnt = [(w + torch.randn_like(w), b + 1.0) for w, b in folded_start(net, 3)]
    frozen = copy.deepcopy(net.layers[:3].state_dict())
    write_back(net, learnt)
    for (weight, bias), (wanted, wanted_bias) in zip(folded_start(net, 3), learnt, strict=True):
        torch.testing.assert_close(weight, wanted, atol=1e-5, rtol=1e-4)
        torch.testing.assert_close(bias, wanted_bias, atol=1e-5, rtol=1e-4)
    for name, value in net.layers[:3].state_dict().items():
        assert torch.equal(value, frozen[name])


def test_the_loss_takes_its_encoding_from_its_name() -> None:
    raw = torch.tensor([[0.0, 0.0, 0.0]])
    assert activate(GraspTask("double").heads, raw)[0].tolist() == [0.5, 0.0, 0.0]
    assert activate(GraspTask("paper").heads, raw)[0].tolist() == [0.5, 0.0, 0.5]
