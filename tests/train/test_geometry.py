"""A network's geometry against torch's own shapes; what does not fit is refused."""

import json
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from networks import networks
from torch import nn

from qsgm import QsgmError
from qsgm.network import LARGEST_SIDE, MOST_LAYERS, WIDEST, Layer, Network, conv
from qsgm.train.model.net import ConvNet, as_seen


@given(networks(2))
def test_a_network_comes_back_from_json_as_it_was(network: Network) -> None:
    assert Network.from_json(json.loads(json.dumps(network.to_json()))) == network


@given(networks(3))
def test_sides_positions_and_counts_are_torchs(network: Network) -> None:
    height, width, channels = network.input_shape
    x, macs = torch.zeros(1, channels, height, width), []
    for number in range(1, network.depth + 1):
        layer = network.layer(number)
        assert network.before(number) == tuple(x.shape[2:])
        assert network.channels_before(number) == x.shape[1]
        assert network.positions_before(number) == x[0, 0].numel()
        module = nn.Conv2d(layer.into, layer.out, layer.kernel, layer.stride, layer.padding)
        x = module(x)
        assert network.convolved(number) == tuple(x.shape[2:])
        assert network.windows(number) == x[0, 0].numel()
        assert layer.weights == sum(p.numel() for p in module.parameters())
        macs.append(module.weight.numel() * x[0, 0].numel())
        pooled = nn.functional.avg_pool2d(x, layer.pool, layer.pool_stride)
        whole = layer.pool == tuple(x.shape[2:]) != (1, 1)
        assert network.pools_all(number) == whole
        x = pooled
        assert network.after(number) == tuple(x.shape[2:])
        assert network.positions_after(number) == x[0, 0].numel()
        assert network.sgm_kernel(number) == tuple(3 if side > 1 else 1 for side in x.shape[2:])
    assert [network.macs(k) for k in range(1, network.depth + 1)] == macs
    assert (network.outputs, tuple(x.shape)) == (3, (1, 3, 1, 1))
    raw = ConvNet(network).eval()(as_seen(network, torch.zeros(2, height, width, channels)))
    assert raw.shape == (2, 3, 1, 1)


@given(networks(2), st.integers(1, 4))
def test_the_last_layers_are_numbered_to_the_end(network: Network, tuned: int) -> None:
    if tuned > network.depth:
        with pytest.raises(QsgmError, match=f"cannot tune the last {tuned} layers: choose 1 to"):
            network.last(tuned)
        return
    last = network.last(tuned)
    assert (len(last), last[-1]) == (tuned, network.depth)


GOOD = (conv(1, 4, 3), conv(4, 2, 6, relu=False))


@pytest.mark.parametrize(
    ("shape", "layers", "kind", "message"),
    [
        ((8, 8, 1), (), "pixels", "1 to 64 layers, got 0"),
        ((8, 8, 1), (conv(1, 1),) * (MOST_LAYERS + 1), "pixels", "1 to 64 layers, got 65"),
        ((8, 8, 1), GOOD, "voices", "inputs are pixels or numbers, got 'voices'"),
        ((0, 8, 1), GOOD, "pixels", "an input has sides from 1"),
        ((8, LARGEST_SIDE + 1, 1), GOOD, "pixels", "an input has sides from 1"),
        ((8, 8, 3), GOOD, "pixels", "layer 1 takes 1 channels, the input has 3"),
        (
            (8, 8, 1),
            (GOOD[0], conv(5, 2, 6)),
            "pixels",
            "layer 2 takes 5 channels, layer 1 gives 4",
        ),
        ((8, 8, 1), (conv(1, 4, 9), GOOD[1]), "pixels", "layer 1 has nothing to see: a kernel"),
        ((8, 8, 1), (conv(1, 4, 3, pool=7), GOOD[1]), "pixels", "layer 1 has nothing to see"),
        ((8, 8, 1), (GOOD[0], conv(4, 2, 7)), "pixels", r"layer 2 .* on maps of \(6, 6\)"),
        ((8, 8, 1), (GOOD[0], conv(4, 2)), "pixels", r"gives maps of \(6, 6\), expected one"),
        ((8, 8, 1), (GOOD[0], conv(4, 2, (6, 1))), "pixels", r"gives maps of \(1, 6\)"),
        ((8, 8, 1), (conv(1, 4, 3, stride=0), GOOD[1]), "pixels", "layer 1 has a size outside"),
        ((8, 8, 1), (conv(1, 4, (3, 0)), GOOD[1]), "pixels", "layer 1 has a size outside"),
        ((8, 8, 1), (GOOD[0], conv(4, WIDEST + 1, 6)), "pixels", "layer 2 has a size outside"),
        (
            (8, 8, 1),
            (conv(1, 4, 3, pool_stride=0), GOOD[1]),
            "pixels",
            "layer 1 has a size outside",
        ),
        ((8, 8, 1), (conv(1, 4, 3, padding=3), GOOD[1]), "pixels", "layer 1 is padded by"),
        ((8, 8, 1), (conv(1, 4, 3, padding=-1), GOOD[1]), "pixels", "layer 1 is padded by"),
        ((8, 8, 1), (conv(1, 0, 3), conv(0, 2, 6)), "pixels", "layer 1 has a size outside"),
    ],
)
def test_a_network_that_does_not_fit_is_refused_by_its_first_wrong_layer(
    shape: tuple[int, int, int], layers: tuple[Layer, ...], kind: Any, message: str
) -> None:
    Network((8, 8, 1), GOOD)
    with pytest.raises(QsgmError, match=message):
        Network(shape, layers, kind)


@given(networks(2), st.data())
def test_a_description_with_something_missing_or_of_another_type_is_refused(
    network: Network, data: st.DataObject
) -> None:
    values = network.to_json()
    place = data.draw(st.sampled_from([values, *values["layers"]]))
    key = data.draw(st.sampled_from(sorted(place)))
    nonsense = [None, "x", 1.5, [], [1], {}, True, [[1, 1]], [1.0, 1], [True, 1], float("nan")]
    wrong = data.draw(st.sampled_from([one for one in nonsense if one != place[key]]))
    if key == "relu" and wrong is True:
        return
    if data.draw(st.booleans()):
        del place[key]
    else:
        place[key] = wrong
    with pytest.raises(QsgmError):
        Network.from_json(values)


@pytest.mark.parametrize("values", [None, 7, "network", [], {}, [[]]])
def test_what_describes_no_network_is_refused(values: Any) -> None:
    with pytest.raises(QsgmError, match="this is no description of a network"):
        Network.from_json(values)
