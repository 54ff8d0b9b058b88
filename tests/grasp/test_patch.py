"""The patch: what is cut out of a demonstration, and that it is kept as it is."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from toys import lay, table, toy

from qsgm import QsgmError
from qsgm.grasp.patch import PATCH_PX, cut_patch, decode_patch, encode_patch, mirrored_square


def test_the_mask_is_the_object_to_a_pixel_or_two() -> None:
    frame = lay(toy(), table(), (320.0, 240.0), 30)
    patch = cut_patch(frame, (320.0, 240.0))
    shape = toy().copy()
    shape[..., :3] = 255
    truth = lay(shape, np.zeros_like(frame), (320.0, 240.0), 30)[160:320, 240:400, 0] > 127
    mask = patch.mask > 0
    assert patch.cut_out
    assert (mask & truth).sum() / (mask | truth).sum() > 0.9
    assert patch.span_px == pytest.approx((90, 36), abs=4)
    assert patch.radius_px == pytest.approx(45, abs=3)


def test_the_same_frame_gives_the_same_mask() -> None:
    frame = lay(toy(), table(), (320.0, 240.0))
    first = cut_patch(frame, (320.0, 240.0)).mask
    cv2.setRNGSeed(7)
    np.testing.assert_array_equal(cut_patch(frame, (320.0, 240.0)).mask, first)


def test_what_cannot_be_told_from_its_table_is_a_disk_and_says_so() -> None:
    patch = cut_patch(table(), (320.0, 240.0))
    side = np.arange(PATCH_PX) - (PATCH_PX - 1) / 2
    assert not patch.cut_out
    near = np.hypot(side[:, None], side) < 38
    far = np.hypot(side[:, None], side) > 42
    assert (patch.mask[near] == 255).all()
    assert (patch.mask[far] == 0).all()


@pytest.mark.parametrize("center", [(320.0, 240.0), (320.4, 239.7), (319.5, 240.5)])
def test_the_centre_is_that_of_the_frame_counted_from_the_patchs_corner(
    center: tuple[float, float],
) -> None:
    frame = lay(toy(), table(), center)
    patch = cut_patch(frame, center)
    x, y = (round(value) for value in patch.center_px)
    np.testing.assert_array_equal(
        patch.image[y - 20 : y + 20, x - 20 : x + 20],
        frame[
            round(center[1]) - 20 : round(center[1]) + 20,
            round(center[0]) - 20 : round(center[0]) + 20,
        ],
    )
    assert patch.center_px == pytest.approx(
        (80 + center[0] - round(center[0]), 80 + center[1] - round(center[1]))
    )


@pytest.mark.parametrize(("left", "top"), [(-30, 5), (100, -7), (90, 60), (10, 10)])
def test_beyond_the_border_a_frame_is_mirrored(left: int, top: int) -> None:
    frame = np.random.default_rng(0).integers(0, 255, (100, 120, 3), dtype=np.uint8)
    padded = cv2.copyMakeBorder(frame, 60, 60, 60, 60, cv2.BORDER_REFLECT_101)
    square = mirrored_square(frame, left, top, 50)
    np.testing.assert_array_equal(square, padded[top + 60 : top + 110, left + 60 : left + 110])


def test_image_and_mask_read_back_as_they_were(tmp_path: Path) -> None:
    patch = cut_patch(lay(toy(), table(), (320.0, 240.0)), (320.0, 240.0))
    image, mask = decode_patch(encode_patch(patch), tmp_path)
    np.testing.assert_array_equal(image, patch.image)
    np.testing.assert_array_equal(mask, patch.mask)


@pytest.mark.parametrize(
    "picture",
    [
        np.zeros((160, 160, 3), np.uint8),
        np.zeros((160, 160, 4), np.uint8),
        np.full((80, 160, 4), 255, np.uint8),
        np.full((160, 160, 4), 255, np.uint16),
    ],
    ids=["no mask", "empty mask", "another size", "16 bit"],
)
def test_another_picture_is_refused(picture: np.ndarray, tmp_path: Path) -> None:
    data = bytes(cv2.imencode(".png", picture)[1])
    with pytest.raises(QsgmError, match=r"is no patch of 160x160 px with a mask; tune the object"):
        decode_patch(data, tmp_path / "patch.png")
    with pytest.raises(QsgmError, match="is no patch"):
        decode_patch(b"nonsense", tmp_path / "patch.png")
