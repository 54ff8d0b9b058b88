"""Losses of heads: their values and errors against torch's own losses, in torch and in a graph."""

from typing import Literal

import numpy as np
import onnxruntime as ort
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from losses import HeadsLoss
from networks import heads, labels_of

from qsgm.runtime import session_options
from qsgm.task import ACTIVATIONS, Head, Heads, LossKind, output_count
from qsgm.train.graphs.build import Graph
from qsgm.train.graphs.loss import activate as graph_activate
from qsgm.train.graphs.loss import loss_and_error
from qsgm.train.heads import (
    LOSSES,
    SMALLEST_ERROR,
    activate,
    error,
    mean_loss,
    meta_objective,
    per_sample,
)

SEEDS = st.integers(0, 2**32 - 1)
COUNT = 7
SINGLE = [
    Head("h", kind, 1 if kind != "cross_entropy" else 3, activation, weight, smoothing)
    for kind, activations in ACTIVATIONS.items()
    for activation in activations
    for weight in (1.0, 2.5)
    for smoothing in ((0.0, 0.1) if kind != "squared" else (0.0,))
]


def drawn(some: Heads, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Raw outputs and labels (N, O) in float64."""
    rng = np.random.default_rng(seed)
    raw = torch.from_numpy(3 * rng.normal(size=(COUNT, output_count(some))))
    return raw, torch.from_numpy(labels_of(some, COUNT, rng)).double()


def run(graph: Graph, raw: torch.Tensor, labels: torch.Tensor) -> list[np.ndarray]:
    model = graph.model().SerializeToString()
    session = ort.InferenceSession(model, session_options(), ["CPUExecutionProvider"])
    feeds = {"raw": raw.numpy().astype(np.float32), "labels": labels.numpy().astype(np.float32)}
    return session.run(None, {x.name: feeds[x.name] for x in session.get_inputs()})


def rounding(some: Heads) -> float:
    """Of an error in float32: an activation is known to 4e-7, and 1 - tanh^2 to twice that."""
    return 2e-6 * max(head.weight for head in some)


def loss_graph(some: Heads) -> Graph:
    graph, count = Graph("loss"), output_count(some)
    raw, labels = (graph.input(x, np.float32, ("batch", count)) for x in ("raw", "labels"))
    mean, found = loss_and_error(graph.within("loss"), some, raw, labels)
    graph.output("loss", mean, np.float32, ())
    graph.output("error", found, np.float32, ("batch", count))
    return graph


def test_every_kind_has_a_loss() -> None:
    assert set(LOSSES) == set(ACTIVATIONS) == {"log_loss", "squared", "cross_entropy"}


@given(heads(), SEEDS)
def test_values_and_errors_are_torchs(some: Heads, seed: int) -> None:
    raw, labels = drawn(some, seed)
    raw.requires_grad_()
    expected = HeadsLoss(some).per_sample(raw, labels)
    (gradient,) = torch.autograd.grad(expected.sum(), raw)
    close = {"rtol": 1e-10, "atol": 1e-12}
    torch.testing.assert_close(per_sample(some, raw, labels), expected, **close)
    torch.testing.assert_close(mean_loss(some, raw, labels), expected.mean(), **close)
    torch.testing.assert_close(error(some, raw.detach(), labels), gradient, **close)
    torch.testing.assert_close(activate(some, raw), HeadsLoss(some).activate(raw), **close)


@given(heads(), SEEDS)
def test_the_graphs_loss_and_error_are_torchs(some: Heads, seed: int) -> None:
    raw, labels = (x.float().double() for x in drawn(some, seed))
    raw.requires_grad_()
    expected = HeadsLoss(some).per_sample(raw, labels)
    (gradient,) = torch.autograd.grad(expected.sum(), raw)
    mean, found = run(loss_graph(some), raw.detach(), labels)
    np.testing.assert_allclose(mean, expected.mean().detach(), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(found, gradient, rtol=1e-5, atol=rounding(some))


@pytest.mark.parametrize("head", SINGLE, ids=lambda h: f"{h.activation}-{h.weight}-{h.smoothing}")
@pytest.mark.parametrize("where", ["everywhere", "where a flag is set"])
def test_each_kind_alone_and_behind_a_flag(
    head: Head, where: Literal["everywhere", "where a flag is set"]
) -> None:
    some: Heads = (head,)
    if where != "everywhere":
        flag = Head("flag", "log_loss", 1, "sigmoid")
        values = {**vars(head), "where": 0}
        some = (flag, Head(**values))
    raw, labels = drawn(some, 3)
    raw.requires_grad_()
    expected = HeadsLoss(some).per_sample(raw, labels)
    (gradient,) = torch.autograd.grad(expected.sum(), raw)
    torch.testing.assert_close(per_sample(some, raw, labels), expected, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(error(some, raw.detach(), labels), gradient, rtol=1e-10, atol=1e-12)
    if where != "everywhere":
        off = labels[:, 0] == 0
        assert 0 < int(off.sum()) < COUNT
        assert (gradient[off, 1:] == 0).all()
        assert (gradient[~off, 1:] != 0).all()
    mean, found = run(loss_graph(some), raw.detach(), labels)
    np.testing.assert_allclose(mean, expected.mean().detach(), rtol=1e-5)
    np.testing.assert_allclose(found, gradient, rtol=1e-5, atol=rounding(some))


@given(heads(), SEEDS)
def test_the_graph_activates_maps_of_outputs_as_torch_does(some: Heads, seed: int) -> None:
    count = output_count(some)
    raw = torch.from_numpy(np.random.default_rng(seed).normal(size=(2, count, 3, 4))).float()
    graph = Graph("activate")
    x = graph.input("raw", np.float32, ("batch", count, 3, 4))
    op = graph.within("activate")
    graph.output("seen", graph_activate(op, some, x), np.float32, ("batch", count, 3, 4))
    (got,) = run(graph, raw, raw)
    rows = raw.permute(0, 2, 3, 1).reshape(-1, count)
    expected = HeadsLoss(some).activate(rows).reshape(2, 3, 4, count).permute(0, 3, 1, 2)
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kind", ["log_loss", "cross_entropy"])
@pytest.mark.parametrize("smoothing", [0.0, 0.1])
def test_the_graphs_loss_stays_finite_and_right_for_extreme_outputs(
    kind: LossKind, smoothing: float
) -> None:
    (activation,) = ACTIVATIONS[kind]
    some = (Head("h", kind, 2, activation, smoothing=smoothing),)
    raw = torch.tensor([[1e4, -1e4], [-1e4, 1e4]], dtype=torch.float64, requires_grad=True)
    labels = torch.tensor([[1.0, 0.0], [1.0, 0.0]], dtype=torch.float64)
    expected = HeadsLoss(some).per_sample(raw, labels)
    (gradient,) = torch.autograd.grad(expected.sum(), raw)
    mean, found = run(loss_graph(some), raw.detach(), labels)
    np.testing.assert_allclose(mean, expected.mean().detach(), rtol=1e-5)
    np.testing.assert_allclose(found, gradient, rtol=1e-5, atol=1e-6)


@given(heads(), SEEDS)
def test_tasks_are_judged_by_logarithms_and_by_roots_of_squares(some: Heads, seed: int) -> None:
    raw, labels = drawn(some, seed)
    got = meta_objective(some, raw[None], labels[None])
    expected, vectors, done = 0.0, {}, 0
    for head in some:
        place = slice(done, done + head.channels)
        done += head.channels
        alone = (Head("h", head.kind, head.channels, head.activation, 1.0, head.smoothing),)
        values = HeadsLoss(alone).per_sample(raw[:, place], labels[:, place]).numpy()
        gate = np.ones(COUNT) if head.where is None else labels[:, head.where].numpy()
        if head.kind == "squared":
            of_vector = vectors.setdefault((head.weight, head.where), [gate, 0.0])
            of_vector[1] += (gate * values).sum()
        else:
            expected += head.weight * (gate * values).mean()
    for (weight, _), (gate, total) in vectors.items():
        expected += weight * np.sqrt(total / max(1, gate.sum()) + SMALLEST_ERROR)
    assert got.shape == (1,)
    assert float(got[0]) == pytest.approx(expected, rel=1e-9)
