"""Every encoding, padding and byte order must give the grey values that went in."""

from __future__ import annotations

import array
from contextlib import suppress
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from fewcal.errors import InvalidInput
from fewcal_ros.messages import compressed_size, compressed_to_grey, image_to_grey, stamp_ns

BT601 = np.array([0.299, 0.587, 0.114])
"""Share of red, green and blue in grey, ITU-R BT.601."""

COLOUR = [
    "rgb8",
    "bgr8",
    "rgba8",
    "bgra8",
    "8UC3",
    "8UC4",
    "rgb16",
    "bgr16",
    "rgba16",
    "bgra16",
    "16UC3",
    "16UC4",
]
MONO = ["mono8", "8UC1", "mono16", "16UC1"]
YUV = ["yuv422", "uyvy", "yuv422_yuy2", "yuyv"]
PLANAR = ["nv21", "nv24"]
BAYER = [f"bayer_{pattern}{bits}" for pattern in ("rggb", "bggr", "gbrg", "grbg") for bits in (8, 16)]


def depth(encoding: str) -> type[np.uint8 | np.uint16]:
    return np.uint16 if "16" in encoding else np.uint8


def message(encoding: str, samples: NDArray[Any], padding: int = 0, big: bool = False) -> Any:
    """An Image message of (H, W) or (H, W, C) samples, its rows padded with noise."""
    height, width = samples.shape[:2]
    rows = samples.astype(samples.dtype.newbyteorder(">" if big else "<")).reshape(height, -1).view(np.uint8)
    noise = np.full((height, padding), 0xA5, np.uint8)
    data = np.hstack([rows, noise])
    return SimpleNamespace(
        encoding=encoding,
        width=width,
        height=height,
        step=data.shape[1],
        is_bigendian=int(big),
        data=data.tobytes(),
    )


def arrange(encoding: str, rgb: NDArray[Any]) -> NDArray[Any]:
    """The samples of an (H, W, 3) colour image in the order of an encoding."""
    names = (
        "bgra"
        if encoding.endswith("C4")
        else "bgr"
        if encoding.endswith("C3")
        else encoding.rstrip("0123456789")
    )
    planes = {"r": rgb[..., 0], "g": rgb[..., 1], "b": rgb[..., 2], "a": np.full_like(rgb[..., 0], 77)}
    return np.stack([planes[name] for name in names], axis=-1)


def mosaic(pattern: str, rgb: NDArray[Any]) -> NDArray[Any]:
    """What a sensor sees behind a Bayer pattern, named by its upper left 2x2 pixels in reading order."""
    seen = np.empty_like(rgb[..., 0])
    for index, colour in enumerate(pattern):
        row, column = divmod(index, 2)
        seen[row::2, column::2] = rgb[row::2, column::2, "rgb".index(colour)]
    return seen


layouts = {
    "width": st.integers(1, 17),
    "height": st.integers(1, 17),
    "padding": st.integers(0, 9),
    "big": st.booleans(),
    "seed": st.integers(0, 2**32 - 1),
}


def noise(seed: int, dtype: type[np.uint8 | np.uint16], *shape: int) -> NDArray[Any]:
    return np.random.default_rng(seed).integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)


@settings(max_examples=25, deadline=None)
@pytest.mark.parametrize("encoding", MONO)
@given(**layouts)
def test_mono_is_returned_as_it_is(
    encoding: str, width: int, height: int, padding: int, big: bool, seed: int
) -> None:
    grey = noise(seed, depth(encoding), height, width)
    result = image_to_grey(message(encoding, grey, padding, big))
    assert result.dtype == depth(encoding)
    assert result.dtype.isnative
    np.testing.assert_array_equal(result, grey)


@settings(max_examples=25, deadline=None)
@pytest.mark.parametrize("encoding", COLOUR)
@given(**layouts)
def test_colour_is_weighted(
    encoding: str, width: int, height: int, padding: int, big: bool, seed: int
) -> None:
    rgb = noise(seed, depth(encoding), height, width, 3)
    result = image_to_grey(message(encoding, arrange(encoding, rgb), padding, big))
    assert result.shape == (height, width)
    assert result.dtype == depth(encoding)
    tolerance = 1.0 if depth(encoding) is np.uint8 else 4.0  # OpenCV weighs with 14-bit integers
    np.testing.assert_allclose(result, rgb @ BT601, rtol=0, atol=tolerance)


@settings(max_examples=25, deadline=None)
@pytest.mark.parametrize("encoding", YUV)
@given(**layouts)
def test_packed_yuv_gives_its_luma(
    encoding: str, width: int, height: int, padding: int, big: bool, seed: int
) -> None:
    luma, chroma = noise(seed, np.uint8, 2, height, width)
    pair = (luma, chroma) if encoding in ("yuyv", "yuv422_yuy2") else (chroma, luma)
    result = image_to_grey(message(encoding, np.stack(pair, axis=-1), padding, big))
    np.testing.assert_array_equal(result, luma)


@pytest.mark.parametrize("encoding", PLANAR)
def test_planar_yuv_gives_its_first_plane(encoding: str) -> None:
    luma = noise(3, np.uint8, 6, 8)
    msg = message(encoding, luma)
    msg.data += bytes(6 * 8 // 2 if encoding == "nv21" else 2 * 6 * 8)
    np.testing.assert_array_equal(image_to_grey(msg), luma)


@settings(max_examples=10, deadline=None)
@pytest.mark.parametrize("encoding", BAYER)
@given(colour=st.tuples(*[st.integers(0, 255)] * 3), padding=st.integers(0, 9), big=st.booleans())
def test_bayer_of_one_colour_gives_its_grey(
    encoding: str, colour: tuple[int, int, int], padding: int, big: bool
) -> None:
    scale = 257 if depth(encoding) is np.uint16 else 1
    rgb = np.broadcast_to(np.array(colour, depth(encoding)) * depth(encoding)(scale), (12, 14, 3))
    result = image_to_grey(message(encoding, mosaic(encoding[6:10], rgb), padding, big))
    assert result.dtype == depth(encoding)
    expected = np.full((12, 14), rgb[0, 0] @ BT601)
    np.testing.assert_allclose(result, expected, rtol=0, atol=1.5 * scale)


@pytest.mark.parametrize("encoding", BAYER)
def test_bayer_leaves_corners_where_they_are(encoding: str) -> None:
    """A reddish chessboard corner, at a place between pixels, is found where it is."""
    corner = np.array([31.3, 28.8])
    y, x = np.mgrid[:60, :64]
    edge = np.tanh((x - corner[0]) / 1.5) * np.tanh((y - corner[1]) / 1.5)  # about the blur of a real edge
    rgb = (np.array([200, 120, 60]) + edge[..., None] * np.array([50, 80, 40])).astype(depth(encoding))
    result = image_to_grey(message(encoding, mosaic(encoding[6:10], rgb))).astype(np.float32)
    found = cv2.cornerSubPix(
        result,
        np.float32([[[31, 29]]]),
        (6, 6),
        (-1, -1),
        (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-4),
    )
    np.testing.assert_allclose(found.ravel(), corner, atol=0.03)


@pytest.mark.parametrize(
    "kind", [bytes, bytearray, lambda raw: array.array("B", raw), lambda raw: np.frombuffer(raw, np.uint8)]
)
def test_data_of_any_library_is_viewed_not_copied(kind: Any) -> None:
    grey = noise(5, np.uint8, 7, 9)
    msg = message("mono8", grey)
    msg.data = kind(msg.data)
    result = image_to_grey(msg)
    np.testing.assert_array_equal(result, grey)
    assert np.shares_memory(result, np.frombuffer(msg.data, np.uint8))


def test_last_row_may_lack_its_padding() -> None:
    grey = noise(6, np.uint8, 5, 6)
    msg = message("mono8", grey, padding=3)
    msg.data = msg.data[:-3]
    np.testing.assert_array_equal(image_to_grey(msg), grey)


@pytest.mark.parametrize(
    ("encoding", "fields", "says"),
    [
        ("mono8", {"step": 7}, "step of 7 bytes"),
        ("rgb8", {"step": 8}, "a row takes 24"),
        ("mono8", {"step": 0}, "step of 0 bytes"),
        ("mono8", {"data": b"\x00" * 47}, "needs 48 bytes .* has 47"),
        ("mono16", {"data": b""}, "has 0"),
        ("mono8", {"width": 0}, "0x6 pixels is empty"),
        ("mono8", {"height": 0}, "8x0 pixels is empty"),
        ("mono8", {"height": 2**32 - 1}, "needs 34359738360 bytes"),
        ("mono8", {"encoding": "32FC1"}, "'32FC1' is not supported; use one of"),
        ("mono8", {"encoding": ""}, "'' is not supported"),
    ],
)
def test_malformed_messages_are_refused_in_one_sentence(
    encoding: str, fields: dict[str, Any], says: str
) -> None:
    samples = (
        arrange(encoding, noise(1, np.uint8, 6, 8, 3))
        if encoding == "rgb8"
        else noise(1, depth(encoding), 6, 8)
    )
    msg = message(encoding, samples)
    vars(msg).update(fields)
    with pytest.raises(InvalidInput, match=says) as caught:
        image_to_grey(msg)
    assert str(caught.value).count(". ") == 0


@settings(max_examples=200, deadline=None)
@given(
    encoding=st.sampled_from([*MONO, *COLOUR, *YUV, *PLANAR, *BAYER]),
    width=st.integers(0, 9),
    height=st.integers(0, 9),
    step=st.integers(0, 80),
    size=st.integers(0, 500),
    big=st.booleans(),
)
def test_any_sizes_give_an_image_or_a_sentence(
    encoding: str, width: int, height: int, step: int, size: int, big: bool
) -> None:
    msg = SimpleNamespace(
        encoding=encoding, width=width, height=height, step=step, is_bigendian=big, data=bytes(size)
    )
    with suppress(InvalidInput):
        assert image_to_grey(msg).shape == (height, width)


def compressed(data: bytes, kind: str = "jpeg") -> Any:
    return SimpleNamespace(format=kind, data=np.frombuffer(data, np.uint8))


def encoded(suffix: str, image: NDArray[Any]) -> bytes:
    return bytes(cv2.imencode(suffix, image)[1])


def smooth() -> NDArray[np.uint8]:
    """A colour image that jpeg keeps well."""
    y, x = np.mgrid[:48, :64]
    return np.stack([x * 3, y * 4, x + y], axis=-1).astype(np.uint8)


def test_png_keeps_its_depth() -> None:
    for dtype in (np.uint8, np.uint16):
        grey = noise(9, dtype, 20, 30)
        result = compressed_to_grey(compressed(encoded(".png", grey), "png"))
        assert result.dtype == dtype
        np.testing.assert_array_equal(result, grey)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_colour_images_become_grey(suffix: str) -> None:
    bgr = smooth()
    result = compressed_to_grey(compressed(encoded(suffix, bgr), "bgr8; jpeg compressed bgr8"))
    np.testing.assert_allclose(result, bgr[..., ::-1] @ BT601, atol=3)


@pytest.mark.parametrize("encoding", BAYER)
def test_a_compressed_mosaic_is_one(encoding: str) -> None:
    rgb = noise(4, depth(encoding), 24, 32, 3)
    samples = mosaic(encoding[6:10], rgb)
    raw = image_to_grey(message(encoding, samples[..., None]))
    packed = encoded(".png", samples)
    np.testing.assert_array_equal(compressed_to_grey(compressed(packed, f"{encoding}; png compressed ")), raw)
    as_it_is = compressed_to_grey(compressed(packed, f"{encoding}; png compressed mono8"))
    np.testing.assert_array_equal(as_it_is, samples)


def test_exif_orientation_is_ignored() -> None:
    """The lens does not turn with the phone: calibration is in sensor pixels."""
    jpeg = encoded(".jpg", smooth())
    tiff = (
        b"MM\x00\x2a\x00\x00\x00\x08\x00\x01\x01\x12\x00\x03\x00\x00\x00\x01\x00\x06\x00\x00\x00\x00\x00\x00"
    )
    exif = b"Exif\x00\x00" + tiff
    turned = jpeg[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + jpeg[2:]
    assert cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR).shape[:2] == (64, 48)
    np.testing.assert_array_equal(
        compressed_to_grey(compressed(turned)), compressed_to_grey(compressed(jpeg))
    )


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("share", [0.0, 0.01, 0.1, 0.5, 0.9, 0.999])
def test_images_cut_off_are_refused_quietly(
    suffix: str, share: float, capfd: pytest.CaptureFixture[str]
) -> None:
    whole = encoded(suffix, noise(11, np.uint8, 48, 64))
    with pytest.raises(InvalidInput, match="format 'jpeg'"):
        compressed_to_grey(compressed(whole[: int(share * len(whole))]))
    assert capfd.readouterr().err == ""


@settings(max_examples=100, deadline=None)
@given(place=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255))
def test_damaged_png_is_refused(place: float, flip: int) -> None:
    data = bytearray(encoded(".png", noise(12, np.uint8, 16, 16)))
    data[int(place * len(data))] ^= flip
    with pytest.raises(InvalidInput):
        compressed_to_grey(compressed(bytes(data), "png"))


def test_jpeg_with_thumbnail_cut_off_is_refused() -> None:
    """The end of the thumbnail is not the end of the image."""
    thumbnail = b"Exif\x00\x00" + encoded(".jpg", smooth()[:8, :8])
    jpeg = encoded(".jpg", smooth())
    whole = jpeg[:2] + b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail + jpeg[2:]
    np.testing.assert_array_equal(compressed_to_grey(compressed(whole)), compressed_to_grey(compressed(jpeg)))
    with pytest.raises(InvalidInput, match="cut off"):
        compressed_to_grey(compressed(whole[:-40]))


@pytest.mark.parametrize("flags", [[cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 2]])
def test_jpeg_of_several_scans_or_with_restarts(flags: list[int]) -> None:
    jpeg = bytes(cv2.imencode(".jpg", noise(13, np.uint8, 48, 64), flags)[1])
    assert compressed_to_grey(compressed(jpeg)).shape == (48, 64)


@pytest.mark.parametrize("flags", [[], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 2]])
def test_the_size_of_a_jpeg_is_in_its_head(flags: list[int]) -> None:
    jpeg = bytes(cv2.imencode(".jpg", noise(13, np.uint8, 48, 64), flags)[1])
    assert compressed_size(compressed(jpeg)) == (64, 48)
    assert compressed_size(compressed(jpeg[: len(jpeg) // 2])) == (64, 48)
    assert compressed_size(compressed(jpeg[:30])) is None


def test_the_size_of_a_thumbnail_is_not_that_of_its_image() -> None:
    thumbnail = b"Exif\x00\x00" + encoded(".jpg", smooth()[:8, :8])
    jpeg = encoded(".jpg", noise(13, np.uint8, 48, 64))
    whole = jpeg[:2] + b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail + jpeg[2:]
    assert compressed_size(compressed(whole)) == (64, 48)


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tiff", ".pgm", ".webp"])
def test_every_kind_tells_its_size(suffix: str) -> None:
    assert compressed_size(compressed(encoded(suffix, noise(13, np.uint8, 48, 64)))) == (64, 48)


@pytest.mark.parametrize(
    "data", [b"", b"\xff\xd8\xff" + b"garbage" * 20, b"\x89PNG\r\n\x1a\n", b"BM", b"h264"]
)
def test_what_is_no_image_has_no_size(data: bytes) -> None:
    assert compressed_size(compressed(data)) is None


def test_jpeg_padded_by_its_driver_is_accepted() -> None:
    jpeg = encoded(".jpg", smooth())
    np.testing.assert_array_equal(
        compressed_to_grey(compressed(jpeg + bytes(100))), compressed_to_grey(compressed(jpeg))
    )


def test_other_compressions_are_refused() -> None:
    with pytest.raises(InvalidInput, match=r"format 'h264' .* is no image of a known kind"):
        compressed_to_grey(compressed(b"\x00\x00\x00\x01\x67" * 20, "h264"))


def test_stamp_is_in_nanoseconds() -> None:
    stamp = SimpleNamespace(sec=1_700_000_000, nanosec=123_456_789)
    assert stamp_ns(SimpleNamespace(header=SimpleNamespace(stamp=stamp))) == 1_700_000_000_123_456_789
