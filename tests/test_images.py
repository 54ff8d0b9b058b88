"""Whatever a user passes is read as a frame or refused in one line."""

import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from refusals import refusal_of

from qsgm.errors import QsgmError
from qsgm.grasp.teach import as_demonstrations
from qsgm.images import check_demonstration, check_frame, read_demonstration, read_frame, write_png


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
    text = refusal_of(read_frame, path)
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
def test_a_truncated_picture_is_refused_in_one_line_and_nothing_else(
    at: Path, suffix: str, kept: float, capfd: pytest.CaptureFixture[str]
) -> None:
    whole = encoded(picture(), suffix)
    at.write_bytes(whole[: max(9, int(len(whole) * kept))])
    assert "is truncated or damaged" in refusal(at)
    assert capfd.readouterr() == ("", "")


def test_a_truncated_png_is_refused_before_it_is_decoded(
    at: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    at.write_bytes(encoded(picture())[:-1])
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("must not decode"))
    assert "is truncated or damaged" in refusal(at)


@pytest.mark.parametrize("missing", [1, 2])
def test_a_whole_jpeg_that_lacks_only_its_end_mark_is_read(at: Path, missing: int) -> None:
    whole = encoded(picture(), ".jpg")
    at.write_bytes(whole)
    frame = read_frame(at)
    at.write_bytes(whole[:-missing])
    np.testing.assert_array_equal(read_frame(at), frame)


def test_a_progressive_jpeg_without_its_end_mark_may_lack_scans_and_is_refused(at: Path) -> None:
    flags = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
    at.write_bytes(bytes(cv2.imencode(".jpg", picture(), flags)[1])[:-2])
    assert "is truncated or damaged" in refusal(at)


@pytest.mark.parametrize("progressive", [0, 1])
@pytest.mark.parametrize("filled", [b"", bytes(2000)])
def test_a_jpeg_with_a_hole_and_an_end_mark_is_refused_in_silence(
    at: Path, progressive: int, filled: bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    # What a USB camera gives that lost a packet.
    flags = [cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_PROGRESSIVE, progressive]
    whole = bytes(cv2.imencode(".jpg", picture(), flags)[1])
    middle = len(whole) // 2
    at.write_bytes(whole[:middle] + filled + whole[middle + 2000 :])
    assert "is truncated or damaged" in refusal(at)
    assert capfd.readouterr() == ("", "")


def test_what_others_say_while_a_picture_is_decoded_reaches_stderr(
    at: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    decode = cv2.imdecode

    def noisy(*arguments: Any) -> Any:
        os.write(2, b"libpng warning: iCCP: known incorrect sRGB profile\nmotor 3 is hot\n")
        return decode(*arguments)

    monkeypatch.setattr(cv2, "imdecode", noisy)
    at.write_bytes(encoded(picture()))
    assert read_frame(at).shape == (480, 640, 3)
    assert capfd.readouterr() == ("", "motor 3 is hot\n")


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_a_sensors_bits_in_sixteen_keep_their_own_high_byte(at: Path, bits: int) -> None:
    image = picture().astype(np.uint16) << (bits - 8)
    at.write_bytes(encoded(image))
    np.testing.assert_array_equal(read_demonstration(at), picture())


def png_of(*chunks: tuple[bytes, bytes]) -> bytes:
    return b"\x89PNG\r\n\x1a\n" + b"".join(png_chunk(*chunk) for chunk in chunks)


def png_header(width: int, height: int) -> tuple[bytes, bytes]:
    return b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)


def jpeg_header(width: int, height: int) -> bytes:
    return b"\xff\xc0" + struct.pack(">HBHHB", 8 + 3 * 3, 8, height, width, 3) + bytes(9)


def hidden_sizes() -> dict[str, bytes]:
    """Files that show one size to who reads the last header, another to who reads the first."""
    whole = encoded(picture(256, 256), ".jpg")
    frame = whole.index(b"\xff\xc0")
    scan = whole.index(b"\xff\xda")
    small, large = png_header(300, 300), png_header(40000, 40000)
    data, end = (b"IDAT", zlib.compress(b"\0" * 100)), (b"IEND", b"")
    scans = whole[scan:-2]
    return {
        "a second IHDR": png_of(large, small, data, end),
        "an IHDR that does not come first": png_of((b"tEXt", b"a\0b"), large, data, end),
        "no IHDR": png_of(data, end),
        "an IHDR of another length": png_of((b"IHDR", small[1] + b"\0"), data, end),
        "a second SOF": whole[:frame] + jpeg_header(40000, 40000) + whole[frame:],
        "a SOF behind the scan": whole[:-2] + jpeg_header(300, 300) + whole[-2:],
        "a scan without a SOF": whole[:frame] + whole[scan:],
        "no scan": whole[:scan] + whole[-2:],
        "scans without end": whole[:-2] + scans * 200 + whole[-2:],
    }


@pytest.mark.parametrize("kind", hidden_sizes())
def test_a_size_that_is_hidden_from_the_check_is_refused_before_anything_is_decoded(
    at: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("must not decode"))
    at.write_bytes(hidden_sizes()[kind])
    assert "is truncated or damaged" in refusal(at)


def test_the_decoder_is_bounded_as_well() -> None:
    # In a process of its own: OpenCV reads the bound when it is loaded.
    script = """
import qsgm, cv2, numpy as np
for side in (4096, 9000):
    encoded = cv2.imencode(".png", np.zeros((side, side), np.uint8))[1]
    try:
        print(cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE) is not None)
    except cv2.error:
        print(False)
"""
    environment = {k: v for k, v in os.environ.items() if k != "OPENCV_IO_MAX_IMAGE_PIXELS"}
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["True", "False"]


@pytest.mark.parametrize(
    "frame",
    [
        None,
        "scene.png",
        np.zeros((480, 640), np.uint8),
        np.zeros((480, 640, 4), np.uint8),
        np.zeros((480, 640, 3), np.float32),
        np.zeros((480, 640, 3), bool),
        np.zeros((3, 480, 640), np.uint8),
        np.zeros((1, 480, 640, 3), np.uint8),
        np.zeros((0, 640, 3), np.uint8),
        np.zeros((1, 5000, 3), np.uint8),
        np.array(3, np.uint8),
    ],
    ids=lambda frame: str(getattr(frame, "shape", frame)),
)
def test_an_array_that_is_no_frame_is_refused_in_one_line_that_blames_it(frame: Any) -> None:
    with pytest.raises(QsgmError, match=r"^the frame is .*: expected .*; ") as raised:
        check_frame(frame)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("frames", [None, "a.png", [None], np.zeros((480, 640), np.uint8)], ids=str)
def test_a_demonstration_that_is_no_frame_is_refused_before_anything_runs(frames: Any) -> None:
    with pytest.raises(QsgmError, match="the frame is"):
        as_demonstrations(frames)


def test_a_frame_seen_in_a_mirror_is_a_frame() -> None:
    mirrored = picture()[:, ::-1, ::-1]
    checked = check_frame(mirrored)
    assert checked.flags["C_CONTIGUOUS"]
    np.testing.assert_array_equal(checked, mirrored)


@pytest.mark.parametrize("name", ["picture.jpg", "picture", "picture.png.txt"])
def test_a_picture_under_the_name_of_another_format_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(QsgmError, match=r"pictures are PNG; pass a name that ends in \.png"):
        write_png(tmp_path / name, picture())
    assert list(tmp_path.iterdir()) == []


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
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(QsgmError, match="cannot write"):
        write_png(tmp_path / "folder.png", picture())
