"""Cells of the object against plain formulas; alignment when a part of it is hidden."""

import math

import numpy as np
import pytest
from toys import lay, table, toy

from qsgm.grasp.cells import ACROSS, CELL, SIDE, upright
from qsgm.grasp.correlation import NOISE_VARIANCE, Fit, Template, pyramid_of
from qsgm.grasp.judge import Appearance
from qsgm.grasp.patch import PATCH_PX, cut_patch

CENTER = (320.0, 240.0)
APPEARANCE = Appearance.of(cut_patch(lay(toy(), table(), CENTER), CENTER))
CELLS = APPEARANCE.aligner.cells


def masked(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    return (values * weight[:, None]).sum(axis=0) / weight.sum()


def covariance(one: np.ndarray, other: np.ndarray, weight: np.ndarray) -> float:
    a, b = one - masked(one, weight), other - masked(other, weight)
    return float(masked(a * b, weight).sum())


def test_every_cell_agrees_by_its_own_masked_correlation() -> None:
    seen = np.random.default_rng(0).uniform(0, 255, (SIDE, SIDE, 3)).astype(np.float32)
    look = CELLS.look(seen)
    for number in range(ACROSS * ACROSS):
        row, column = divmod(number, ACROSS)
        here = np.s_[row * CELL : (row + 1) * CELL, column * CELL : (column + 1) * CELL]
        weight = CELLS.solid[here].astype(float).ravel()
        assert CELLS.share[number] == pytest.approx(weight.sum() / CELLS.solid.sum(), abs=1e-6)
        if weight.sum() < 4:
            continue
        a, b = (one[here].astype(float).reshape(-1, 3) for one in (seen, CELLS.image))
        size = (covariance(a, a, weight) + NOISE_VARIANCE) * (
            covariance(b, b, weight) + NOISE_VARIANCE
        )
        expected = covariance(a, b, weight) / math.sqrt(size)
        assert look.agreement[number] == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize("seed", range(3))
def test_all_cells_together_are_one_weighted_image(seed: int) -> None:
    rng = np.random.default_rng(seed)
    seen = np.clip(CELLS.image * 0.7 + rng.normal(20, 9, CELLS.image.shape), 0, 255)
    seen = seen.astype(np.float32)
    weight = (CELLS.share * rng.uniform(0, 1, CELLS.share.shape)).astype(np.float32)
    weight /= weight.sum()
    whole = CELLS.look(seen).whole(weight)
    by_cell = (weight / CELLS.size).reshape(ACROSS, ACROSS)
    pixels = (np.kron(by_cell, np.ones((CELL, CELL))) * CELLS.solid).astype(float).ravel()
    a, b = (one.astype(float).reshape(-1, 3) for one in (seen, CELLS.image))
    own, taught = (covariance(one, one, pixels) for one in (a, b))
    both = covariance(a, b, pixels)
    size = (own + NOISE_VARIANCE) * (taught + NOISE_VARIANCE)
    assert whole.correlation == pytest.approx(both / math.sqrt(size), abs=2e-3)
    assert whole.gain == pytest.approx(both / taught, rel=5e-3)
    np.testing.assert_allclose(whole.mean, masked(a, pixels), rtol=1e-3)


def test_an_image_compared_with_itself_agrees_but_for_the_noise() -> None:
    look = CELLS.look(CELLS.image)
    np.testing.assert_allclose(look.agreement, CELLS.variance / CELLS.noisy, atol=2e-3)
    assert look.trust.sum() == pytest.approx(1, abs=1e-5)
    assert look.score <= 1


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("off", [(3.0, -2.0, 3.0, 1.04), (-3.0, 3.0, -4.0, 0.96)])
def test_a_third_of_the_object_may_be_hidden_and_the_rest_is_aligned(
    side: int, off: tuple[float, float, float, float]
) -> None:
    scene = lay(toy(), table(2), CENTER, 20)
    # Something bright over one end, across the object.
    x = CENTER[0] + side * 33 * math.cos(math.radians(20))
    scene[195:285, round(x) - 14 : round(x) + 14] = (240, 250, 30)
    right, down, turn, scale = off
    start = Fit(0.0, math.radians(20 + turn), scale, (319.5 + right, 239.5 + down))
    fit, look = APPEARANCE.aligner.aligned(pyramid_of(scene), start)
    assert math.dist(APPEARANCE.center_of(fit), CENTER) < 1
    assert abs(math.degrees(fit.turn_rad) - 20) < 1
    assert look.score == fit.score


@pytest.mark.parametrize("off", [(6.0, 0.0), (-6.0, 0.0), (0.0, 6.0), (0.0, -6.0)])
def test_a_fit_may_be_off_as_far_above_and_below_as_to_the_sides(off: tuple[float, float]) -> None:
    scene = pyramid_of(lay(toy(), table(1), CENTER, 40))
    start = Fit(0.0, math.radians(40), 1.0, (CENTER[0] + off[0], CENTER[1] + off[1]))
    fit, _ = APPEARANCE.aligner.aligned(scene, start)
    assert math.dist(APPEARANCE.center_of(fit), CENTER) < 0.5


def test_what_cells_are_cut_from_is_the_patchs_middle_at_half_size_its_mask_a_share() -> None:
    patch = cut_patch(lay(toy(), table(), CENTER), CENTER)
    image, mask = upright(Template(patch))
    assert (image.shape, mask.shape) == ((SIDE, SIDE, 3), (SIDE, SIDE))
    edge = (PATCH_PX - 2 * SIDE) // 2
    middle = np.s_[edge : edge + 2 * SIDE, edge : edge + 2 * SIDE]
    blocks = patch.mask[middle].reshape(SIDE, 2, SIDE, 2).mean(axis=(1, 3)) / 255
    np.testing.assert_allclose(mask, blocks, atol=1e-6)
    colors = patch.image[middle].reshape(SIDE, 2, SIDE, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(image, colors, atol=1e-3)
