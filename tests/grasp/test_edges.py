"""Edges where the taught object has them: met by itself, not by what is larger or turned."""

import numpy as np
import pytest
from toys import lay, table, toy

from qsgm.grasp.correlation import Fit, pyramid_of
from qsgm.grasp.edges import Edges
from qsgm.grasp.judge import Appearance
from qsgm.grasp.patch import Patch, cut_patch

CENTER = (320.0, 240.0)
APPEARANCE = Appearance.of(cut_patch(lay(toy(), table(), CENTER), CENTER))


def seen_in(scene: np.ndarray, turn_deg: float = 0.0) -> tuple[Edges, float]:
    """Its edges, and how firmly the object's place holds there."""
    fit = Fit(0.0, np.deg2rad(turn_deg), 1.0, (319.5, 239.5))
    look = APPEARANCE.aligner.look(pyramid_of(scene), fit)
    edges = APPEARANCE.edges.met_by(look.seen)
    return edges, edges.firmness(look)


def test_the_demonstration_meets_its_own_edges() -> None:
    edges, firmness = seen_in(lay(toy(), table(), CENTER))
    assert edges.agreement == pytest.approx(1, abs=0.02)
    assert edges.outline > 0.4
    assert firmness > 2


def test_another_table_and_light_change_edges_little_and_another_turn_much() -> None:
    own, firm = seen_in(lay(toy(), table(5, grey=60), CENTER, light=0.6))
    turned, loose = seen_in(lay(toy(), table(5, grey=60), CENTER), 90)
    assert own.agreement > 0.6 > 0.4 > turned.agreement
    assert own.outline > 1.3 * turned.outline
    assert firm > loose + 1


def test_a_thing_that_is_larger_has_no_edge_where_the_object_ends() -> None:
    plain = np.zeros_like(toy())
    plain[..., :3] = (60, 70, 200)
    plain[100:380, 20:460, 3] = 255
    taught, _ = seen_in(lay(toy(), table(5), CENTER))
    wide, _ = seen_in(lay(plain, table(5), CENTER))
    assert wide.outline < 0.6 * taught.outline


@pytest.mark.parametrize("pixel", [(0, 0), (159, 159), (80, 80), None])
@pytest.mark.parametrize("grey", [0, 255, None])
def test_any_patch_and_scene_give_finite_edges(
    pixel: tuple[int, int] | None, grey: int | None
) -> None:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (160, 160, 3)).astype(np.uint8)
    mask = np.full((160, 160), 255 if pixel is None else 0, np.uint8)
    if pixel is not None:
        mask[pixel] = 255
    image = noise if grey is None else np.full_like(noise, grey)
    appearance = Appearance.of(Patch(image, mask))
    for scene in (np.zeros((300, 330, 3), np.uint8), np.tile(noise, (2, 3, 1))[:300, :330]):
        look = appearance.aligner.look(pyramid_of(scene), Fit(0.0, 0.3, 1.0, (150.0, 150.0)))
        edges = appearance.edges.met_by(look.seen)
        assert np.isfinite([edges.agreement, edges.outline, edges.firmness(look)]).all()
        assert -1 <= edges.agreement <= 1 + 1e-6
        assert 0 <= edges.outline <= 1 + 1e-6
