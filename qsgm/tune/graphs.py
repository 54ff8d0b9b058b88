"""A bundle's graphs, opened for a run: each takes and gives what a run binds to it, or is refused.

Hashes say that a bundle is the one that was written, not what its graphs are; what they are to be,
docs/bundle.md says.
"""

from collections.abc import Collection, Mapping
from contextlib import AbstractContextManager
from typing import Any

import onnxruntime as ort
from numpy.typing import NDArray

from qsgm.bundle import Bundle
from qsgm.errors import QsgmError
from qsgm.manifest import COMMAND
from qsgm.network import Network
from qsgm.runtime import Value, check_interface, running
from qsgm.tune.plan import Overrides, Plan

NEXT = "_next"
_ADVICE = f"export it again with `{COMMAND}`"
_FLOAT = "tensor(float)"
_SCALAR: Value = (_FLOAT, ())
_FEATURE_TYPES = ("tensor(uint8)", _FLOAT)
# What each optimizer keeps of a weight and of a bias.
_MOMENTS = {"sgd": ("momentum",), "adam": ("mean", "square")}
Values = dict[str, Value]


def open_trunk(bundle: Bundle, plan: Plan) -> ort.InferenceSession:
    """The frozen layers: samples to features."""
    network, (height, width, channels) = bundle.network, bundle.network.input_shape
    kind = "tensor(uint8)" if network.input_kind == "pixels" else _FLOAT
    takes: Values = {"samples": (kind, (None, height, width, channels))}
    session = bundle.session(plan.trunk_file, plan.settings.threads)
    gives = _features(session.get_outputs(), network, plan.layers[0])
    return _checked(session, bundle, plan.trunk_file, takes, gives)


def open_head(bundle: Bundle, plan: Plan) -> ort.InferenceSession:
    """The tuned layers: features and weights to outputs."""
    session = bundle.session(plan.head_file, plan.settings.threads)
    takes = _features(session.get_inputs(), bundle.network, plan.layers[0])
    takes |= _weights(bundle.network, plan.layers)
    gives: Values = {"outputs": (_FLOAT, (None, bundle.network.outputs))}
    return _checked(session, bundle, plan.head_file, takes, gives)


def open_step(bundle: Bundle, plan: Plan) -> ort.InferenceSession:
    """A training step: state to the next state, and the loss."""
    int8_layers = plan.blocks.sgm_layers if plan.precision == "int8" else ()
    constants = constants_of(plan.overrides, int8_layers)
    session = bundle.session(plan.step_file, plan.settings.threads, constants)
    state = _state(bundle.network, plan)
    takes = _batch(session, bundle.network, plan) | state
    takes |= {f"rate{k}": _SCALAR for k in plan.layers}
    gives = {f"{name}{NEXT}": value for name, value in state.items()} | {"loss": _SCALAR}
    return _checked(session, bundle, plan.step_file, takes, gives)


def open_probe(bundle: Bundle, plan: Plan) -> ort.InferenceSession:
    """The graph that compares gradients. Raises QsgmError where the bundle has none."""
    if not bundle.has(plan.probe_file):
        raise QsgmError(
            f"the bundle {bundle.folder} has no {plan.probe_file}, by which SGMs are looked at; "
            f"{_ADVICE}"
        )
    constants = constants_of(plan.overrides, plan.layers)
    session = bundle.session(plan.probe_file, plan.settings.threads, constants)
    network, gives = bundle.network, Values()
    for k in plan.sgm_blocks.sgm_layers:
        layer = network.layer(k)
        sample: Value = (_FLOAT, (None, network.positions_after(k), layer.out))
        update: Value = (_FLOAT, (layer.out, layer.window + 1))
        gives |= {f"{kind}{k}": sample for kind in ("activation", "true", "float", "int8")}
        gives |= {f"update_{kind}{k}": update for kind in ("true", "float", "int8")}
        gives |= {f"{kind}{k}": _SCALAR for kind in ("clipped", "underflow")}
    takes = _batch(session, network, plan) | _weights(network, plan.layers)
    return _checked(session, bundle, plan.probe_file, takes, gives)


def constants_of(overrides: Overrides, layers: Collection[int]) -> dict[str, NDArray[Any]]:
    """Overriding constants of the SGMs behind `layers`, by initializer name."""
    return {name: array for layer in layers for name, array in overrides.get(layer, {}).items()}


def running_graphs(bundle: Bundle) -> AbstractContextManager[None]:
    """Around every run of a bundle's graph: they are checked when opened, not for what they do."""
    return running(f"the bundle {bundle.folder}", _ADVICE)


def _checked(
    session: ort.InferenceSession,
    bundle: Bundle,
    name: str,
    takes: Mapping[str, Value],
    gives: Mapping[str, Value],
) -> ort.InferenceSession:
    check_interface(session, f"{name} of the bundle {bundle.folder}", takes, gives, _ADVICE)
    return session


def _features(values: Any, network: Network, first: int) -> Values:
    """Of the first tuned layer: u8 codes, pixels or numbers, as the graph itself has them."""
    kinds = {value.name: value.type for value in values}
    kind = kinds.get("features")
    shape = (None, network.positions_before(first), network.channels_before(first))
    return {"features": (kind if kind in _FEATURE_TYPES else _FEATURE_TYPES[0], shape)}


def _batch(session: ort.InferenceSession, network: Network, plan: Plan) -> Values:
    """All samples, and which of them make the batch."""
    labels: Value = (_FLOAT, (None, network.outputs))
    features = _features(session.get_inputs(), network, plan.layers[0])
    return features | {"labels": labels, "rows": ("tensor(int64)", (None,))}


def _weights(network: Network, layers: range) -> Values:
    found = Values()
    for k in layers:
        layer = network.layer(k)
        found[f"weight{k}"] = (_FLOAT, (layer.out, layer.window))
        found[f"bias{k}"] = (_FLOAT, (layer.out,))
    return found


def _state(network: Network, plan: Plan) -> Values:
    """Weights, and what the optimizer keeps of them."""
    optimizer, state = plan.recipe.optimizer, _weights(network, plan.layers)
    for k in plan.layers:
        layer = network.layer(k)
        for moment in _MOMENTS[optimizer]:
            state[f"weight_{moment}{k}"] = (_FLOAT, (layer.out, layer.window))
            state[f"bias_{moment}{k}"] = (_FLOAT, (1, layer.out))
    return state | ({"step": _SCALAR} if optimizer == "adam" else {})
