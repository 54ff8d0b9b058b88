"""Correlation and alignment against plain formulas and objects laid between pixels."""

import math

import numpy as np
import pytest
from toys import lay, table, toy

from qsgm.grasp import correlation
from qsgm.grasp.alignment import as_taught
from qsgm.grasp.correlation import (
    COARSE,
    FINE,
    NOISE_VARIANCE,
    Fit,
    Pyramid,
    Template,
    agreement,
    coarse_fits,
    correlate,
    in_parts,
    pyramid_of,
    windows_around,
)
from qsgm.grasp.judge import Appearance, best_fit
from qsgm.grasp.patch import cut_patch

CENTER = (320.0, 240.0)
DEMONSTRATION = lay(toy(), table(), CENTER)
APPEARANCE = Appearance.of(cut_patch(DEMONSTRATION, CENTER))


def turn_error(fit: Fit, turn_deg: float) -> float:
    return abs((math.degrees(fit.turn_rad) - turn_deg + 180) % 360 - 180)


def test_every_halving_is_the_mean_of_four_pixels_whatever_the_size() -> None:
    frame = np.random.default_rng(0).integers(0, 255, (101, 131, 3), dtype=np.uint8)
    scene = pyramid_of(frame)
    first = frame[:100, :130].astype(float).reshape(50, 2, 65, 2, 3).mean(axis=(1, 3))
    second = scene.level(1)[:, :64].astype(float).reshape(25, 2, 32, 2, 3).mean(axis=(1, 3))
    np.testing.assert_array_equal(scene.level(1), first)
    np.testing.assert_array_equal(scene.level(2), second)


def test_windows_are_the_frames_pixels_around_their_centres() -> None:
    scene = pyramid_of(np.random.default_rng(0).integers(0, 255, (300, 400, 3), dtype=np.uint8))
    windows, places = windows_around(scene, FINE, (203.0, 151.0), 2)
    # A diamond, those at most two steps away, each in 4x4 parts.
    assert windows.shape == (16, 13, 3, 16 * 16)
    for number, (x, y) in enumerate(places):
        left, top = round((x + 0.5) / 2 - 32), round((y + 0.5) / 2 - 32)
        expected = scene.level(FINE)[top : top + 64, left : left + 64].transpose(2, 0, 1)
        for part, (row, column) in zip(windows[:, number], np.ndindex(4, 4), strict=True):
            here = np.s_[:, 16 * row : 16 * row + 16, 16 * column : 16 * column + 16]
            np.testing.assert_array_equal(part, expected[here].reshape(3, -1))
    middle = places.mean(axis=0)
    assert np.abs(middle - (203, 151)).max() <= 1
    assert len({tuple(place) for place in places.tolist()}) == 13
    assert np.abs(places - middle).sum(axis=1).max() == 4


def middle_of_the_layer() -> np.ndarray:
    """Image and mask (16, 16, 4) that windows meet in the pose of the demonstration."""
    layer = APPEARANCE.template.layer(COARSE)
    margin = (len(layer) - 16) // 2
    return layer[margin : margin + 16, margin : margin + 16].astype(float)


def masked_correlation(window: np.ndarray, patch: np.ndarray) -> float:
    """Of images (h, w, 3) and (h, w, 4), each channel around its mean."""
    mask = patch[..., 3].ravel() / patch[..., 3].sum()
    a, b = window.reshape(-1, 3).T, patch[..., :3].reshape(-1, 3).T
    a, b = (x - (x * mask).sum(axis=1, keepdims=True) for x in (a, b))
    both, own, taught = (float((x * y * mask).sum()) for x, y in ((a, b), (a, a), (b, b)))
    return both / math.sqrt((own + NOISE_VARIANCE) * (taught + NOISE_VARIANCE))


def test_correlation_is_that_of_the_masked_pixels_each_channel_around_its_mean() -> None:
    windows = np.random.default_rng(1).uniform(0, 255, (3, 16, 16, 3)).astype(np.float32)
    trials = APPEARANCE.template.trials(COARSE, [(0.3, 1.0), (0.0, 1.0)])
    scores = correlate(in_parts(windows)[trials.live], trials)
    for window, score in zip(windows.astype(float), scores, strict=True):
        assert score[1] == pytest.approx(
            masked_correlation(window, middle_of_the_layer()), abs=1e-4
        )
        assert score[0] != score[1]


def test_parts_of_a_patch_agree_each_by_its_own_masked_correlation() -> None:
    windows = np.random.default_rng(2).uniform(0, 255, (3, 16, 16, 3)).astype(np.float32)
    middle = middle_of_the_layer()
    trials = APPEARANCE.template.trials(COARSE, [(0.0, 1.0)])
    assert len(trials.live) < 16  # else what is left out would not be seen
    found = agreement(in_parts(windows)[trials.live], trials)
    for window, one in zip(windows.astype(float), found, strict=True):
        apart = 0.0
        for row, column in np.ndindex(4, 4):
            here = np.s_[4 * row : 4 * row + 4, 4 * column : 4 * column + 4]
            covered = middle[here][..., 3].sum()
            if covered:
                cosine = masked_correlation(window[here], middle[here])
                apart += max(cosine, 0.0) * covered / middle[..., 3].sum()
        whole = masked_correlation(window, middle)
        assert one[0] == pytest.approx(whole / 3 + apart * 2 / 3, abs=1e-4)


def test_parts_keep_the_turn_of_an_object_that_is_half_hidden_where_one_correlation_loses_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def found() -> float:
        return float(np.mean([turn_is_among(half_hidden(turn), turn) for turn in TURNS]))

    with_parts = found()
    monkeypatch.setattr(correlation, "agreement", correlate)
    assert with_parts > 0.5
    assert found() < 0.2


TURNS = range(0, 360, 15)


def half_hidden(turn_deg: float) -> Pyramid:
    """The object with a bright square over one end."""
    scene, turn = lay(toy(), table(1), CENTER, turn_deg), math.radians(turn_deg)
    x, y = round(CENTER[0] - 40 * math.cos(turn)), round(CENTER[1] + 40 * math.sin(turn))
    scene[y - 25 : y + 25, x - 25 : x + 25] = (240, 250, 30)
    return pyramid_of(scene)


def turn_is_among(scene: Pyramid, turn_deg: float) -> bool:
    (fits,) = coarse_fits(APPEARANCE.template, scene, [CENTER])
    return any(turn_error(fit, turn_deg) < 16 for fit in fits)


def test_the_demonstration_itself_is_found_where_and_as_it_lies() -> None:
    fit, lead = best_fit(APPEARANCE, DEMONSTRATION, (327.0, 233.0))
    assert math.dist(APPEARANCE.center_of(fit), CENTER) < 0.05
    assert turn_error(fit, 0) < 0.05
    assert fit.scale == pytest.approx(1, abs=0.002)
    assert fit.score > 0.8
    assert lead > 0.2


@pytest.mark.parametrize("seed", range(12))
def test_an_object_is_laid_on_between_pixels_turns_and_scales(seed: int) -> None:
    rng = np.random.default_rng(seed)
    center = (320 + rng.uniform(-150, 150), 240 + rng.uniform(-100, 100))
    turn, scale = rng.uniform(-180, 180), rng.uniform(0.85, 1.18)
    scene = lay(toy(), table(seed + 1), center, turn, scale, light=rng.uniform(0.6, 1.1))
    near = (center[0] + rng.uniform(-11, 11), center[1] + rng.uniform(-11, 11))
    fit, _ = best_fit(APPEARANCE, scene, near)
    assert math.dist(APPEARANCE.center_of(fit), center) < 0.3
    assert turn_error(fit, turn) < 0.3
    assert fit.scale == pytest.approx(scale, rel=0.01)


@pytest.mark.parametrize("center", [(320.5, 239.5), (320.3, 240.4)])
def test_a_demonstration_between_pixels_keeps_its_centre(center: tuple[float, float]) -> None:
    appearance = Appearance.of(cut_patch(lay(toy(), table(), center), center))
    scene = lay(toy(), table(3), (250.25, 200.75), 180)
    fit, _ = best_fit(appearance, scene, (250.0, 200.0))
    assert math.dist(appearance.center_of(fit), (250.25, 200.75)) < 0.2


def test_the_same_object_at_the_border_of_a_frame_is_found_as_well() -> None:
    scene = lay(toy(), table(2), (70.0, 400.0), 77)
    fit, _ = best_fit(APPEARANCE, scene, (64.0, 400.0))
    assert math.dist(APPEARANCE.center_of(fit), (70, 400)) < 0.5


def test_the_two_ways_round_of_an_object_without_a_front_are_level() -> None:
    frame = lay(toy(front=False), table(), CENTER)
    appearance = Appearance.of(cut_patch(frame, CENTER))
    fit, lead = best_fit(appearance, lay(toy(front=False), table(1), CENTER, 40), CENTER)
    assert min(turn_error(fit, 40), turn_error(fit, -140)) < 0.5
    assert lead < 0.02


def test_coarse_fits_are_of_different_turns_the_best_first() -> None:
    scene = pyramid_of(lay(toy(), table(1), CENTER, 123))
    (fits,) = coarse_fits(Template(APPEARANCE.template.patch), scene, [CENTER])
    assert [fit.score for fit in fits] == sorted((fit.score for fit in fits), reverse=True)
    assert turn_error(fits[0], 123) < 8
    turns = [math.degrees(fit.turn_rad) for fit in fits]
    assert all(abs((a - b + 180) % 360 - 180) > 25 for i, a in enumerate(turns) for b in turns[:i])


def test_a_scene_moved_back_by_its_fit_is_the_demonstration() -> None:
    center, turn, scale = (290.3, 260.8), 70.0, 1.1
    scene = pyramid_of(lay(toy(), table(), center, turn, scale))
    fit = Fit(0, math.radians(turn), scale, center)
    taught = as_taught(pyramid_of(DEMONSTRATION), Fit(0, 0, 1.0, CENTER))
    seen = as_taught(scene, fit)
    mask = APPEARANCE.aligner.cells.solid >= 0.5
    assert np.abs(seen - taught)[mask].mean() < 6
    wrong = as_taught(scene, Fit(0, math.radians(turn + 20), scale, center))
    assert np.abs(wrong - taught)[mask].mean() > 15
