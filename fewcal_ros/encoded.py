"""Encoded images (jpeg, png, ...) to grey arrays, refusing those that are damaged.

Calibration happens in sensor pixels, so an EXIF orientation is ignored: a picture turned for viewing would
be a different camera. 16-bit images stay 16 bit.

Decoders are lenient: given half a jpeg, some return a picture whose lower half is grey, and write their
complaint to stderr. What can be said from the container alone is therefore checked before decoding.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable, Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from fewcal.errors import InvalidInput
from fewcal.grey import GreyImage

_FLAGS = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


_TIFF_VALUE_BYTES = {3: 2, 4: 4, 5: 8, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8}
"""Size of a value by its type, TIFF 6.0 section 2; all other types take one byte."""


_JPEG_MARKER = re.compile(rb"\xff+([^\x00\xff])", re.DOTALL)
_JPEG_MARKER_BEHIND_SCAN = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]", re.DOTALL)
"""Inside a scan, 0xff is followed by zero or is a restart marker."""


_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers of the segments that hold the size."""


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, int]]:
    """Marker and begin of segment after segment; damage inside a scan may go unnoticed."""
    position = 2
    while marker := _JPEG_MARKER.match(data, position):
        kind, position = marker[1][0], marker.end()
        yield kind, position
        position += int.from_bytes(data[position : position + 2], "big")
        if kind == 0xDA:
            following = _JPEG_MARKER_BEHIND_SCAN.search(data, position)
            position = following.start() if following else len(data)


def _jpeg_is_whole(data: bytes) -> bool:
    """Whether segment follows segment up to the end marker."""
    return any(kind == 0xD9 for kind, _ in _jpeg_segments(data))


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    begin = next((begin for kind, begin in _jpeg_segments(data) if kind in _JPEG_FRAMES), len(data))
    if begin + 7 > len(data):
        return None
    height, width = struct.unpack_from(">HH", data, begin + 3)
    return width, height


def _png_is_whole(data: bytes) -> bool:
    position = len(_PNG_SIGNATURE)
    while position + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, position)
        end = position + 8 + length
        if end + 4 > len(data):
            return False
        if struct.unpack_from(">I", data, end)[0] != zlib.crc32(data[position + 4 : end]):
            return False
        if kind == b"IEND":
            return True
        position = end + 4
    return False


def _bmp_is_whole(data: bytes) -> bool:
    return len(data) >= 26 and struct.unpack_from("<I", data, 2)[0] <= len(data)


def _tiff_is_whole(data: bytes) -> bool:
    """Whether the first directory and the values it points at are there; it often comes last in the file."""
    order = "<" if data.startswith(b"II") else ">"
    try:
        (start,) = struct.unpack_from(order + "I", data, 4)
        (count,) = struct.unpack_from(order + "H", data, start)
        entries = struct.iter_unpack(order + "HHII", data[start + 2 : start + 2 + 12 * count])
        ends = [
            offset + number * _TIFF_VALUE_BYTES.get(kind, 1)
            for _, kind, number, offset in entries
            if number * _TIFF_VALUE_BYTES.get(kind, 1) > 4  # smaller ones stand in place of the offset
        ]
    except struct.error:
        return False
    return all(end <= len(data) for end in (start + 2 + 12 * count, *ends))


def _webp_is_whole(data: bytes) -> bool:
    return len(data) >= 12 and struct.unpack_from("<I", data, 4)[0] + 8 <= len(data)


def _pnm_is_whole(data: bytes) -> bool:
    blank = rb"(?:\s|#[^\n]*\n)+"
    head = re.match(rb"P([1-6])" + blank + rb"(\d{1,9})" + blank + rb"(\d{1,9})", data)
    if head is None:
        return False
    kind, width, height = (int(head[i]) for i in (1, 2, 3))
    # Least size of the pixels: binary bitmaps hold 8 of them in a byte, all else at least one.
    per_row = {4: (width + 7) // 8, 3: 3 * width, 6: 3 * width}.get(kind, width)
    return len(data) - head.end() >= per_row * height


# What a file of each kind begins with, and whether it is all there.
_KINDS: tuple[tuple[re.Pattern[bytes], Callable[[bytes], bool]], ...] = (
    (re.compile(rb"\xff\xd8\xff"), _jpeg_is_whole),
    (re.compile(re.escape(_PNG_SIGNATURE)), _png_is_whole),
    (re.compile(rb"BM"), _bmp_is_whole),
    (re.compile(rb"II\*\x00|MM\x00\*"), _tiff_is_whole),
    (re.compile(rb"P[1-6]\s"), _pnm_is_whole),
    (re.compile(rb"RIFF....WEBP", re.DOTALL), _webp_is_whole),
)


def looks_like_image(head: bytes) -> bool:
    """Whether a file that begins with these bytes (16 are enough) is an image of a known kind."""
    return any(start.match(head) for start, _ in _KINDS)


def encoded_size(data: bytes) -> tuple[int, int] | None:
    """(width, height) of an image file held in memory, pixels; None when it is no image.

    That of a jpeg or png is read from its head, which takes no time; all others are decoded.
    """
    if data.startswith(b"\xff\xd8\xff"):
        return _jpeg_size(data)
    if data.startswith(_PNG_SIGNATURE) and len(data) >= 24:
        width, height = struct.unpack_from(">II", data, 16)
        return width, height
    try:
        rows, columns = decode_grey(data, "").shape
    except InvalidInput:
        return None
    return columns, rows


def decode_grey(data: bytes, what: str) -> GreyImage:
    """Decode an image file held in memory.

    Parameters
    ----------
    data : bytes
        The file: jpeg, png, bmp, tiff, pnm or webp.
    what : str
        How to call the image in an error, such as its file name.

    Returns
    -------
    ndarray, (H, W), uint8 or uint16
        Grey values; 16-bit images keep their depth. No EXIF rotation is applied.

    Raises
    ------
    InvalidInput
        When the image is of an unknown kind, cut off or damaged.
    """
    is_whole = next((check for start, check in _KINDS if start.match(data)), None)
    if is_whole is None:
        raise InvalidInput(
            f"{what} ({len(data)} bytes) is no image of a known kind; use jpeg, png, bmp, tiff, pnm or webp."
        )
    if not is_whole(data):
        raise InvalidInput(f"{what} ({len(data)} bytes) is cut off or damaged; use another.")
    try:
        image: NDArray[np.generic] | None = cv2.imdecode(np.frombuffer(data, np.uint8), _FLAGS)
    except cv2.error:
        image = None
    if image is None or image.ndim != 2 or image.size == 0:
        raise InvalidInput(f"{what} ({len(data)} bytes) cannot be decoded; use another.")
    if image.dtype not in (np.uint8, np.uint16):
        raise InvalidInput(f"{what} holds {image.dtype} pixels; use images of 8 or 16 bit.")
    return image  # type: ignore[return-value]
