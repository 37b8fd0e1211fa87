"""Square markers with an identity: what dictionaries there are, how they look, and which one a square shows.

The dictionaries are those of OpenCV's module aruco, which has changed its interface in 4.7; what differs is
hidden here.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .errors import InvalidInput
from .grey import GreyImage
from .marker_geometry import map_grid
from .saddle_points import sample

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Bits = NDArray[np.bool_]

_ARUCO: Any = getattr(cv2, "aruco", None)

DICTIONARIES: dict[str, tuple[int, int]] = {
    **{f"DICT_{n}X{n}_{count}": (n, count) for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)},
    "DICT_ARUCO_ORIGINAL": (5, 1024),
    "DICT_APRILTAG_16h5": (4, 30),
    "DICT_APRILTAG_25h9": (5, 35),
    "DICT_APRILTAG_36h10": (6, 2320),
    "DICT_APRILTAG_36h11": (6, 587),
    "DICT_ARUCO_MIP_36h12": (6, 250),
}
"""OpenCV's predefined dictionaries: bits along the edge of a marker, and how many markers there are."""
MIN_RECOGNISED = 2
"""Markers that must be of one dictionary before it is named: one may be chance."""
SAMPLES = 2
"""Points that are looked at in each bit, each way."""
MAX_BRIGHT_BORDER = 0.1
"""Share of the black border that may be bright: a highlight, or a corner of the square that is not seen."""


def find_dictionary(name: str) -> str:
    """Give the proper spelling of a dictionary's name, or the name itself when there is none."""
    return next((known for known in DICTIONARIES if known.lower() == name.strip().lower()), name)


def check_dictionary(name: str, markers: int) -> None:
    """Refuse a dictionary that OpenCV does not have, or one with fewer markers than a board needs."""
    if not isinstance(name, str) or name not in DICTIONARIES:
        raise InvalidInput(f"There is no dictionary {name!r}; there are {', '.join(DICTIONARIES)}.")
    if markers > DICTIONARIES[name][1]:
        raise InvalidInput(
            f"{name} has {DICTIONARIES[name][1]} markers, the board needs {markers}; choose a smaller board "
            "or a larger dictionary."
        )


def marker_bits(name: str, ids: Indices) -> Bits:
    """(M, n, n) bits of markers without their border, row by row downwards; True is white."""
    dictionary, size = _dictionary(name), DICTIONARIES[name][0]
    bits = [_ARUCO.Dictionary_getBitsFromByteList(dictionary.bytesList[i : i + 1], size) for i in ids]
    return np.array(bits, dtype=bool).reshape(-1, size, size)


def read_levels(grey: GreyImage, quads: Array, cells: int, inset: float = 0.0) -> Array:
    """(K, cells, cells) mean brightness of the bits of markers, their border among them.

    Parameters
    ----------
    grey : (H, W) array
    quads : (K, 4, 2)
        Corners of the squares that the markers are in, pixels, clockwise in the image.
    cells : int
        Bits along the edge of a marker with its border.
    inset : float
        Distance of a marker from the edges of the square, as a share of these.
    """
    if len(quads) == 0:
        return np.empty((0, cells, cells))
    shares = inset + (1 - 2 * inset) * (np.arange(cells * SAMPLES) + 0.5) / (cells * SAMPLES)
    levels = sample(grey, map_grid(quads, shares))
    return np.asarray(levels.reshape(-1, cells, SAMPLES, cells, SAMPLES).mean(axis=(2, 4)))


def read_markers(levels: Array, name: str) -> tuple[Indices, Indices]:
    """Tell markers of a dictionary by the brightness of their bits.

    Parameters
    ----------
    levels : (K, cells, cells)
        See :func:`read_levels`.
    name : str
        One of `DICTIONARIES`.

    Returns
    -------
    ids : (K,)
        Place of each in the dictionary, -1 where it is none.
    turns : (K,)
        By how many right angles it is turned anticlockwise.

    Raises
    ------
    InvalidInput
        When this OpenCV has no such dictionary.
    """
    codes = _codes(name)
    bits, bordered = _bits(levels, DICTIONARIES[name][0])
    ids, turns = np.full(len(levels), -1), np.zeros(len(levels), np.intp)
    if bordered.any():
        signs = _signs(bits[bordered])
        agreement = signs @ codes.reshape(-1, signs.shape[1]).T
        wrong = (signs.shape[1] - agreement.max(axis=1)) / 2
        turns[bordered], best = np.divmod(agreement.argmax(axis=1), codes.shape[1])
        ids[bordered] = np.where(wrong <= _correctable(name), best, -1)
    return ids, turns


def recognise(grey: GreyImage, quads: Array, border_bits: int = 1, inset: float = 0.0) -> str | None:
    """Name the dictionary that most of some squares show markers of, all bits being right.

    Parameters
    ----------
    grey, quads, inset
        See :func:`read_levels`.
    border_bits : int
        Width of the black border in bits.
    """
    hits = dict.fromkeys(DICTIONARIES, 0)
    for size in {size for size, _ in DICTIONARIES.values()}:
        bits, bordered = _bits(read_levels(grey, quads, size + 2 * border_bits, inset), size)
        if not bordered.any():
            continue
        signs = _signs(bits[bordered])
        for name in hits:
            if DICTIONARIES[name][0] == size and hasattr(_ARUCO, name):
                hits[name] = _exact(signs, name)
    best = max(hits, key=lambda name: hits[name])  # of several that have them all the smallest comes first
    return best if hits[best] >= MIN_RECOGNISED else None


def in_mirror(
    grey: GreyImage, quads: Array, name: str, border_bits: int = 1, inset: float = 0.0, least: int = 0
) -> bool:
    """Whether squares that show no markers show more than so many in a mirror, all bits being right.

    Parameters
    ----------
    grey, quads, border_bits, inset
        See :func:`recognise`.
    name : str
        One of `DICTIONARIES`.
    least : int
        Markers that were read without a mirror, as chance may have it.
    """
    size = DICTIONARIES[name][0]
    bits, bordered = _bits(read_levels(grey, quads[:, ::-1], size + 2 * border_bits, inset), size)
    return bool(bordered.any()) and _exact(_signs(bits[bordered]), name) >= max(MIN_RECOGNISED, least + 1)


def _exact(signs: NDArray[np.float32], name: str) -> int:
    """How many of some markers, bits as signs (K, n * n), are those of a dictionary in every bit."""
    codes = _codes(name).reshape(-1, signs.shape[1])
    return int(((signs @ codes.T).max(axis=1) == signs.shape[1]).sum())


def _bits(levels: Array, size: int) -> tuple[Bits, NDArray[np.bool_]]:
    """Bits (K, size, size) inside the border, and which of the markers (K,) have a black one."""
    cells = levels.shape[1]
    border = (cells - size) // 2
    middle = (levels.max(axis=(1, 2)) + levels.min(axis=(1, 2))) / 2
    white = levels > middle[:, None, None]
    inner = white[:, border:-border, border:-border]
    bright = white.sum(axis=(1, 2)) - inner.sum(axis=(1, 2))
    return inner, bright <= MAX_BRIGHT_BORDER * (cells**2 - size**2)


def _signs(bits: Bits) -> NDArray[np.float32]:
    """(..., n * n) 1 for a white bit and -1 for a black one."""
    signs = np.where(bits, np.float32(1), np.float32(-1))
    return signs.reshape(*bits.shape[:-2], bits.shape[-1] ** 2)


@lru_cache(maxsize=len(DICTIONARIES))
def _codes(name: str) -> NDArray[np.float32]:
    """(4, M, n * n) signs of the markers of a dictionary, turned four ways."""
    bits = marker_bits(name, np.arange(DICTIONARIES[name][1]))
    return np.stack([_signs(np.rot90(bits, turn, axes=(1, 2))) for turn in range(4)])


@lru_cache(maxsize=8)
def _correctable(name: str) -> int:
    """How many wrong bits still leave no doubt which marker it is."""
    codes = _codes(name)
    most = -int(codes.shape[2])
    for turn, turned in enumerate(codes):
        agreement = codes[0] @ turned.T
        if turn == 0:
            np.fill_diagonal(agreement, most)  # itself
        most = max(most, int(agreement.max()))
    differing = (int(codes.shape[2]) - most) // 2
    return max(differing - 1, 0) // 2


@lru_cache(maxsize=8)
def _dictionary(name: str) -> Any:
    code = getattr(_ARUCO, name, None)
    if code is None:
        raise InvalidInput(
            f"OpenCV {cv2.__version__} as it is installed has no markers of {name}; install "
            "a later opencv-python-headless, or the package with contrib in its name."
        )
    return _ARUCO.getPredefinedDictionary(code)
