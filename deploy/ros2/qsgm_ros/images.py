"""Camera images as frames, and frames as camera images, without cv_bridge or ROS.

An image is whatever has the fields of `sensor_msgs/Image`.
"""

import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qsgm import QsgmError
from qsgm.errors import as_text
from qsgm.images import check_frame

Frame = NDArray[np.uint8]

# By encoding, which byte of a pixel is blue, green and red; and how many a pixel has.
ENCODINGS = {
    "bgr8": ((0, 1, 2), 3),
    "rgb8": ((2, 1, 0), 3),
    "bgra8": ((0, 1, 2), 4),
    "rgba8": ((2, 1, 0), 4),
    "mono8": ((0, 0, 0), 1),
}


def frame_of(image: Any) -> Frame:
    """An image's pixels, (height, width, 3) BGR.

    Raises:
        QsgmError: its encoding is another one, or its sizes contradict each other.
    """
    if image.encoding not in ENCODINGS:
        raise QsgmError(
            f"the image's encoding is {as_text(image.encoding)!r}: expected one of "
            f"{', '.join(ENCODINGS)}; convert it, as image_proc does"
        )
    order, channels = ENCODINGS[image.encoding]
    height, width, step = image.height, image.width, image.step
    data = np.frombuffer(image.data, np.uint8)
    if min(height, width) < 1 or step < width * channels or len(data) != step * height:
        raise QsgmError(
            f"the image has {len(data)} bytes, {height} rows of {step} for {width} pixels of "
            f"{channels}: expected rows no shorter than their pixels, and as many bytes as they "
            "have; check the camera's driver"
        )
    # Rows may be longer than their pixels.
    pixels = data.reshape(height, step)[:, : width * channels].reshape(height, width, channels)
    return check_frame(pixels[:, :, order])


def fill_image(image: Any, frame: Frame, header: Any) -> Any:
    """An empty image, with a frame (H, W, 3) BGR in it."""
    image.header = header
    image.height, image.width = frame.shape[:2]
    image.encoding = "bgr8"
    image.is_bigendian = int(sys.byteorder == "big")
    image.step = frame.shape[1] * 3
    image.data = frame.tobytes()
    return image
