"""Curvature against the product that it stands for, written out."""

import torch

from qsgm.grasp.network import GRASPNET
from qsgm.train.model.curvature import Curvature
from qsgm.train.model.local import LayerState, local_step


def random_curvature(layer: int, seed: int = 0) -> Curvature:
    generator = torch.Generator().manual_seed(seed)
    matrices = Curvature.identity(GRASPNET.layer(layer)).matrices
    return Curvature(*(torch.randn(m.shape, generator=generator) for m in matrices))


def test_the_identity_bends_nothing() -> None:
    d_weight, d_bias = torch.randn(2, 400, 16), torch.randn(2, 16)
    bent = Curvature.identity(GRASPNET.layer(4)).precondition(d_weight, d_bias)
    torch.testing.assert_close(bent, (d_weight, d_bias))


def test_each_matrix_multiplies_its_own_axis_of_the_gradient() -> None:
    curvature = random_curvature(4)
    d_weight, d_bias = torch.randn(2, 400, 16), torch.randn(2, 16)
    weight, bias = curvature.precondition(d_weight, d_bias)
    # One matrix for the whole weight: K is ordered (window, input channel).
    whole = torch.kron(curvature.window, curvature.into)
    expected = whole.T @ d_weight @ curvature.out
    torch.testing.assert_close(weight, expected, atol=1e-3, rtol=1e-4)
    torch.testing.assert_close(bias, d_bias @ curvature.bias)


def test_a_local_step_descends_along_the_bent_gradient() -> None:
    curvature = random_curvature(6)
    state = LayerState.start(torch.randn(2, 16, 3), torch.randn(2, 3))
    features, labels = torch.rand(2, 5, 1, 16), torch.rand(2, 5, 3)
    rate = [torch.tensor(0.1)]

    def gradient_of(_: int, activation: torch.Tensor, __: torch.Tensor) -> torch.Tensor:
        return activation.cos()

    (plain,) = local_step(GRASPNET, [state], features, labels, rate, gradient_of)
    (bent,) = local_step(GRASPNET, [state], features, labels, rate, gradient_of, {6: curvature})
    expected = curvature.precondition(plain.weight_momentum, plain.bias_momentum)
    torch.testing.assert_close((bent.weight_momentum, bent.bias_momentum), expected)
    torch.testing.assert_close(bent.weight, state.weight - 0.1 * expected[0])
