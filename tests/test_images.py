"""Whatever a user passes is read as a frame or refused in one line."""

import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from qsgm.errors import QsgmError
from qsgm.images import check_demonstration, read_demonstration, read_frame, write_png


def picture(height: int = 480, width: int = 640) -> NDArray[np.uint8]:
    """Smooth noise: PNG keeps it exactly and JPEG nearly."""
    noise = np.random.default_rng(3).integers(0, 256, (height, width, 3), dtype=np.uint8)
    smooth = cv2.GaussianBlur(noise, (0, 0), 4)
    low, high = int(smooth.min()), int(smooth.max())
    return ((smooth.astype(np.int32) - low) * 255 // (high - low)).astype(np.uint8)


def encoded(image: NDArray[np.integer[Any]], suffix: str = ".png") -> bytes:
    return bytes(cv2.imencode(suffix, image)[1])


def png_chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png_declaring(width: int, height: int) -> bytes:
    """A few bytes with an intact structure that declare any size."""
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(b"\0" * 100)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(png_chunk(*chunk) for chunk in chunks)


@pytest.fixture
def at(tmp_path: Path) -> Path:
    return tmp_path / "frame.png"


def refusal(path: Path) -> str:
    with pytest.raises(QsgmError) as raised:
        read_frame(path)
    text = str(raised.value)
    assert "\n" not in text
    assert text.count(str(path)) == 1
    return text


def test_a_png_is_read_exactly(at: Path) -> None:
    image = picture()
    at.write_bytes(encoded(image))
    frame = read_frame(at)
    assert frame.dtype == np.uint8
    np.testing.assert_array_equal(frame, image)


@pytest.mark.parametrize("progressive", [0, 1])
def test_a_jpeg_is_read_whatever_its_name(at: Path, progressive: int) -> None:
    image = picture()
    flags = [cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_PROGRESSIVE, progressive]
    flags += [cv2.IMWRITE_JPEG_RST_INTERVAL, 4]
    at.write_bytes(bytes(cv2.imencode(".jpg", image, flags)[1]))
    assert np.abs(read_frame(at).astype(int) - image).mean() < 2


def test_grey_becomes_three_equal_channels(at: Path) -> None:
    grey = picture()[:, :, 0]
    at.write_bytes(encoded(grey))
    np.testing.assert_array_equal(read_frame(at), np.repeat(grey[:, :, None], 3, axis=2))


def test_alpha_is_dropped_even_where_all_is_transparent(at: Path) -> None:
    image = picture()
    at.write_bytes(encoded(np.dstack([image, np.zeros_like(image[:, :, 0])])))
    np.testing.assert_array_equal(read_frame(at), image)


def test_sixteen_bit_channels_keep_their_high_byte(at: Path) -> None:
    wide = np.random.default_rng(0).integers(0, 65536, (200, 300, 3), dtype=np.uint16)
    at.write_bytes(encoded(wide))
    np.testing.assert_array_equal(read_frame(at), (wide >> 8).astype(np.uint8))


def test_a_large_frame_keeps_its_size(at: Path) -> None:
    at.write_bytes(encoded(picture(1080, 1920)))
    assert read_frame(at).shape == (1080, 1920, 3)


def test_a_missing_file_is_refused(at: Path) -> None:
    assert "does not exist" in refusal(at)


def test_a_folder_is_refused(tmp_path: Path) -> None:
    assert "is a folder" in refusal(tmp_path)


def test_a_device_is_refused_without_reading_it() -> None:
    assert "is not a regular file" in refusal(Path("/dev/zero"))


def test_a_name_that_is_too_long_is_refused(tmp_path: Path) -> None:
    assert "file name too long" in refusal(tmp_path / ("n" * 300))


def test_an_empty_file_is_refused(at: Path) -> None:
    at.write_bytes(b"")
    assert "is empty" in refusal(at)


@pytest.mark.parametrize("content", [b"hello, I am not a picture", b"\0" * 4000, b"\x89PNG"])
def test_a_file_that_is_no_picture_is_refused(at: Path, content: bytes) -> None:
    at.write_bytes(content)
    assert "is not a PNG or JPEG picture" in refusal(at)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("kept", [0.0005, 0.01, 0.3, 0.9, 0.999])
def test_a_truncated_picture_is_refused_in_one_line_before_it_is_decoded(
    at: Path, suffix: str, kept: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Some decoders fill up what is missing, others complain on stderr: none is to see it.
    whole = encoded(picture(), suffix)
    at.write_bytes(whole[: max(9, int(len(whole) * kept))])
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("must not decode"))
    assert "is truncated or damaged" in refusal(at)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_picture_without_the_last_byte_is_refused_in_silence(
    at: Path, suffix: str, capfd: pytest.CaptureFixture[str]
) -> None:
    at.write_bytes(encoded(picture(), suffix)[:-1])
    assert "is truncated or damaged" in refusal(at)
    assert capfd.readouterr() == ("", "")


def test_bytes_after_the_end_mark_do_not_matter(at: Path) -> None:
    at.write_bytes(encoded(picture()) + b"trailing")
    assert read_frame(at).shape == (480, 640, 3)


def test_a_png_with_a_flipped_bit_is_refused_in_silence(
    at: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    data = bytearray(encoded(picture()))
    data[len(data) // 2] ^= 1
    at.write_bytes(data)
    assert "is truncated or damaged" in refusal(at)
    assert capfd.readouterr() == ("", "")


def test_a_png_whose_pixels_do_not_fill_the_declared_size_is_refused(at: Path) -> None:
    at.write_bytes(png_declaring(300, 300))
    assert "is truncated or damaged" in refusal(at)


@pytest.mark.parametrize("size", [(60000, 60000), (4097, 300), (2**31 - 1, 2**31 - 1)])
def test_a_decompression_bomb_is_refused_before_it_is_decoded(
    at: Path, size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("must not decode"))
    at.write_bytes(png_declaring(*size))
    text = refusal(at)
    assert f"{size[0]}x{size[1]} px" in text
    assert "at most 4096 px" in text


def test_a_jpegs_declared_size_is_checked_before_it_is_decoded(
    at: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = encoded(picture(), ".jpg")
    start = data.index(b"\xff\xc0") + 5
    at.write_bytes(data[:start] + struct.pack(">HH", 65500, 65000) + data[start + 4 :])
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("must not decode"))
    assert "65000x65500 px" in refusal(at)


def test_a_huge_file_is_refused_before_it_is_read(at: Path) -> None:
    with at.open("wb") as sparse:
        sparse.truncate(10**12)
    assert "1000000 MB" in refusal(at)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_tiny_picture_is_refused(at: Path, suffix: str) -> None:
    at.write_bytes(encoded(picture(8, 8), suffix))
    text = refusal(at)
    assert "8x8 px" in text
    assert "at least 128 px" in text


def test_the_smallest_frame_is_one_window(at: Path) -> None:
    at.write_bytes(encoded(picture(128, 128)))
    assert read_frame(at).shape == (128, 128, 3)
    at.write_bytes(encoded(picture(127, 128)))
    assert "128x127 px" in refusal(at)


def test_a_demonstration_is_a_frame_of_at_least_256_px(at: Path) -> None:
    at.write_bytes(encoded(picture(256, 256)))
    assert read_demonstration(at).shape == (256, 256, 3)
    at.write_bytes(encoded(picture(255, 640)))
    with pytest.raises(QsgmError, match=r"640x255 px, too small .* 640x480 .* 60 to 110 px"):
        read_demonstration(at)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("color", [(0, 0, 0), (255, 255, 255), (30, 140, 90)])
def test_a_flat_colour_is_a_frame_but_no_demonstration(
    at: Path, suffix: str, color: tuple[int, int, int]
) -> None:
    at.write_bytes(encoded(np.full((480, 640, 3), color, dtype=np.uint8), suffix))
    assert read_frame(at).shape == (480, 640, 3)
    with pytest.raises(QsgmError, match="shows one flat colour") as raised:
        read_demonstration(at)
    assert "\n" not in str(raised.value)


def test_an_object_that_differs_in_one_channel_only_is_contrast_enough() -> None:
    frame = np.full((480, 640, 3), 128, dtype=np.uint8)
    frame[200:280, 280:360, 1] = 180
    check_demonstration(frame, Path("object.png"))


def test_a_written_png_reads_back_exactly(tmp_path: Path) -> None:
    image = picture()
    write_png(tmp_path / "new" / "picture.png", image)
    np.testing.assert_array_equal(read_frame(tmp_path / "new" / "picture.png"), image)


def test_a_picture_that_cannot_be_written_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(QsgmError, match="cannot write"):
        write_png(tmp_path, picture())
