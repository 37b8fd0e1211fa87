"""Image messages to grey arrays.

The messages are duck-typed: what rclpy hands out and what rosbags deserialises have the same fields. The
detector wants grey values, so that is what every encoding is reduced to, at its own depth: YUV has them
ready (Y), colour is weighted as usual, Bayer is interpolated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fewcal.errors import InvalidInput
from fewcal.grey import GreyImage

from .encoded import decode_grey, encoded_size


@dataclass(frozen=True, eq=False)
class Frame:
    """One image, ready for detection.

    Parameters
    ----------
    image : ndarray, (H, W), uint8 or uint16
        Grey values. May be a read-only view of the message.
    stamp_ns : int or None
        Time of the image, nanoseconds; None for image files.
    frame_id : str
        The frame the message names; empty for image files.
    source : str
        Where it comes from: ``run.mcap:/camera/image_raw@1699.123456789`` or a file name.
    """

    image: GreyImage
    stamp_ns: int | None
    frame_id: str
    source: str


OTHER_CAMERA = "other camera"
"""Why a frame is turned away whose frame_id is not that of the views."""


@dataclass(frozen=True)
class _Layout:
    """How an encoding lays out a pixel: bits and number of its samples, and how they become grey.

    Without an OpenCV ``conversion``, the sample at index ``grey_sample`` is grey already.
    """

    bits: int
    samples: int
    grey_sample: int = 0
    conversion: int | None = None


_SINGLE = {
    **{name: _Layout(8, 1) for name in ("mono8", "8UC1")},
    **{name: _Layout(16, 1) for name in ("mono16", "16UC1")},
    # Planar YUV: the Y plane comes first and is all that is needed.
    **{name: _Layout(8, 1) for name in ("nv21", "nv24")},
}

_PACKED_YUV = {
    **{name: _Layout(8, 2, grey_sample=1) for name in ("yuv422", "uyvy")},
    **{name: _Layout(8, 2, grey_sample=0) for name in ("yuv422_yuy2", "yuyv")},
}

_COLOUR = {
    f"{order}{bits}": _Layout(bits, len(order), conversion=code)
    for bits in (8, 16)
    for order, code in (
        ("rgb", cv2.COLOR_RGB2GRAY),
        ("bgr", cv2.COLOR_BGR2GRAY),
        ("rgba", cv2.COLOR_RGBA2GRAY),
        ("bgra", cv2.COLOR_BGRA2GRAY),
    )
}

# ROS names a Bayer pattern by its upper left 2x2 pixels, OpenCV by those one to the right and down.
_BAYER = {
    f"bayer_{pattern}{bits}": _Layout(bits, 1, conversion=code)
    for bits in (8, 16)
    for pattern, code in (
        ("rggb", cv2.COLOR_BayerBG2GRAY),
        ("bggr", cv2.COLOR_BayerRG2GRAY),
        ("gbrg", cv2.COLOR_BayerGR2GRAY),
        ("grbg", cv2.COLOR_BayerGB2GRAY),
    )
}

_LAYOUTS: dict[str, _Layout] = {
    **_SINGLE,
    **_PACKED_YUV,
    **_COLOUR,
    **_BAYER,
    # Unnamed colour channels are taken as cv_bridge takes them.
    "8UC3": _COLOUR["bgr8"],
    "8UC4": _COLOUR["bgra8"],
    "16UC3": _COLOUR["bgr16"],
    "16UC4": _COLOUR["bgra16"],
}


def stamp_ns(msg: Any) -> int:
    """Time in the header of a message, nanoseconds."""
    return int(msg.header.stamp.sec) * 1_000_000_000 + int(msg.header.stamp.nanosec)


def image_to_grey(msg: Any) -> GreyImage:
    """Grey values of a sensor_msgs/Image.

    Parameters
    ----------
    msg : sensor_msgs/Image
        Of any source: only its fields are used. Rows may be padded, 16-bit samples in either byte order.

    Returns
    -------
    ndarray, (H, W), uint8 or uint16
        At the depth of the encoding. A view of the message where its bytes can be used as they are.

    Raises
    ------
    InvalidInput
        When the encoding is not known, or sizes and data contradict each other.
    """
    layout = _LAYOUTS.get(msg.encoding)
    if layout is None:
        raise InvalidInput(
            f"The image encoding {msg.encoding!r} is not supported; use one of {', '.join(sorted(_LAYOUTS))}."
        )
    samples = _samples(msg, layout)
    if layout.conversion is None:
        return np.ascontiguousarray(samples[:, :, layout.grey_sample])
    return cv2.cvtColor(np.ascontiguousarray(samples), layout.conversion)  # type: ignore[return-value]


def _samples(msg: Any, layout: _Layout) -> NDArray[Any]:
    """View the bytes of a message as its (H, W, samples) values, in the byte order of this machine."""
    width, height, step = int(msg.width), int(msg.height), int(msg.step)
    what = f"The {msg.encoding} image of {width}x{height} pixels"
    if width <= 0 or height <= 0:
        raise InvalidInput(f"{what} is empty; check the driver's image size.")
    sample_bytes = layout.bits // 8
    row_bytes = width * layout.samples * sample_bytes
    if step < row_bytes:
        raise InvalidInput(
            f"{what} has a step of {step} bytes but a row takes {row_bytes}; fix step in the driver."
        )
    data = memoryview(msg.data)
    needed = step * (height - 1) + row_bytes
    if data.nbytes < needed:
        raise InvalidInput(
            f"{what} needs {needed} bytes at a step of {step} but has {data.nbytes}; it is damaged."
        )
    order = ">" if msg.is_bigendian else "<"
    values: NDArray[Any] = np.ndarray(
        (height, width, layout.samples),
        np.dtype(f"{order}u{sample_bytes}"),
        buffer=data,
        strides=(step, layout.samples * sample_bytes, sample_bytes),
    )
    return values.astype(values.dtype.newbyteorder("="), copy=False)


def compressed_to_grey(msg: Any) -> GreyImage:
    """Grey values of a sensor_msgs/CompressedImage.

    Parameters
    ----------
    msg : sensor_msgs/CompressedImage
        Holding jpeg or png; which of the two is read from the data, not from ``format``. That says whether
        it is a Bayer mosaic: "bayer_rggb8; jpeg compressed ", where an encoding at the end is another one.

    Returns
    -------
    ndarray, (H, W), uint8 or uint16
        16 bit for a 16-bit png.

    Raises
    ------
    InvalidInput
        When the data is no such image, cut off or damaged.
    """
    grey = decode_grey(bytes(msg.data), f"The compressed image of format {msg.format!r}")
    encoding, _, rest = msg.format.partition(";")
    mosaic = _BAYER[encoding].conversion if encoding in _BAYER else None
    if mosaic is None or not rest.rstrip().endswith("compressed"):
        return grey
    return cv2.cvtColor(grey, mosaic)  # type: ignore[return-value]


def raw_size(msg: Any) -> tuple[int, int]:
    """(width, height) of a sensor_msgs/Image, pixels."""
    return int(msg.width), int(msg.height)


def compressed_size(msg: Any) -> tuple[int, int] | None:
    """(width, height) of a sensor_msgs/CompressedImage, pixels; None when it cannot be read."""
    return encoded_size(bytes(msg.data))


IMAGE_TYPES: dict[str, Callable[[Any], GreyImage]] = {
    "sensor_msgs/msg/Image": image_to_grey,
    "sensor_msgs/msg/CompressedImage": compressed_to_grey,
}
"""The message types that hold an image, and what makes a grey array of each."""
