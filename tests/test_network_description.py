"""A network's description is read as it was written, nonsense refused by what is wrong with it."""

import json
from typing import Any

import pytest
from damage import JUNK, damaged
from hypothesis import given
from toy_task import NETWORK as TOY

from qsgm import QsgmError
from qsgm.grasp.network import GRASPNET
from qsgm.network import Network, conv

KEPT = GRASPNET.to_json()
LINE = Network(
    (1, 40, 3),
    (
        conv(3, 4, (1, 5), stride=(1, 2), padding=(0, 2), pool=(1, 2), pool_stride=(1, 2)),
        conv(4, 2, (1, 10), relu=False),
    ),
    "numbers",
)


def read_or_refusal(values: Any) -> Network | str:
    """A network, or what is said against it."""
    try:
        return Network.from_json(values)
    except QsgmError as error:
        return str(error)


@pytest.mark.parametrize("network", [GRASPNET, TOY, LINE], ids=["grasp", "toy", "line"])
def test_networks_are_read_as_they_are_written(network: Network) -> None:
    assert Network.from_json(json.loads(json.dumps(network.to_json()))) == network


@given(damaged(KEPT) | JUNK)
def test_other_values_are_refused_in_one_line_or_read_as_they_are(values: Any) -> None:
    network = read_or_refusal(values)
    if isinstance(network, str):
        assert "\n" not in network
    else:
        assert network.to_json() == values


def changed(number: int, **values: Any) -> dict[str, Any]:
    layers = [dict(layer) for layer in KEPT["layers"]]
    layers[number - 1] |= values
    return KEPT | {"layers": layers}


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({**KEPT, "input_kind": "text"}, "inputs are pixels or numbers"),
        ({**KEPT, "input_shape": [128, 128, 4]}, "layer 1 takes 3 channels, the input has 4"),
        ({**KEPT, "input_shape": [0, 128, 3]}, "sides from 1 to 4096"),
        ({**KEPT, "input_shape": [128, 10**9, 3]}, "sides from 1 to 4096"),
        ({**KEPT, "input_shape": [16, 16, 3]}, "layer 3 has nothing to see"),
        ({**KEPT, "input_shape": [192, 192, 3]}, "the last layer gives maps of"),
        ({**KEPT, "input_shape": [128, 3]}, "no description of a network"),
        ({**KEPT, "input_shape": [128.0, 128, 3]}, "no whole number"),
        ({**KEPT, "layers": []}, "a network has 1 to 64 layers, got 0"),
        ({**KEPT, "layers": KEPT["layers"] * 11}, "a network has 1 to 64 layers, got 66"),
        (changed(2, into=7), "layer 2 takes 7 channels, layer 1 gives 8"),
        (changed(3, stride=[0, 1]), "layer 3 has a size outside of 1 to 4096"),
        (changed(3, kernel=[-5, 5]), "layer 3 has a size outside"),
        (changed(4, padding=[5, 0]), "layer 4 is padded by"),
        (changed(4, padding=[-1, 0]), "layer 4 is padded by"),
        (changed(5, relu=1), "no truth value"),
        (changed(6, out=True), "no whole number"),
        (changed(6, kernel=1), "no description of a network"),
    ],
)
def test_a_network_that_cannot_be_is_refused_by_what_is_wrong(
    values: dict[str, Any], said: str
) -> None:
    with pytest.raises(QsgmError, match=said) as raised:
        Network.from_json(values)
    assert "\n" not in str(raised.value)


def test_layers_are_counted_from_the_last_one() -> None:
    assert [*GRASPNET.last(2)] == [5, 6]
    assert [*LINE.last(2)] == [1, 2]
    with pytest.raises(QsgmError, match="last 3 layers: choose 1 to 2"):
        LINE.last(3)


def test_an_sgm_has_windows_along_the_sides_that_there_are() -> None:
    assert [GRASPNET.sgm_kernel(k) for k in (1, 3, 4)] == [(3, 3), (3, 3), (1, 1)]
    assert LINE.sgm_kernel(1) == (1, 3)
