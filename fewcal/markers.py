"""Square markers with an identity: what dictionaries there are, how they look, where an image shows them.

Dictionaries and search are those of OpenCV's module aruco, which has changed its interface in 4.7; what
differs is hidden here.
"""

from __future__ import annotations

from dataclasses import dataclass
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
MIN_BIT_PX = 1.5
"""Smallest bit of a marker that is looked for: below it the bits of one marker run into each other."""
SMALL_MARKER_PX = 120.0
"""Markers with shorter edges are recognised more often in an image of twice the size: that removes
noise, and thin bits are not lost."""
MIN_RECOGNISED = 2
"""Candidates that must be of one dictionary before it is named: one may be chance."""


@dataclass(frozen=True, eq=False)
class Markers:
    """Markers found in an image.

    Attributes
    ----------
    ids : (M,)
        Place of each in its dictionary.
    corners : (M, 4, 2)
        Pixels: upper left, upper right, lower right, lower left corner of the marker as it is printed.
    candidates : (K, 4, 2)
        Other dark quadrangles, whose bits are none of the dictionary's.
    """

    ids: Indices
    corners: Array
    candidates: Array

    def __len__(self) -> int:
        return len(self.ids)

    def take(self, chosen: NDArray[np.bool_] | Indices) -> Markers:
        """Some of the markers, and all candidates."""
        return Markers(self.ids[chosen], self.corners[chosen], self.candidates)


def find_dictionary(name: str) -> str:
    """Give the proper spelling of a dictionary's name, or the name itself when there is none."""
    return next((known for known in DICTIONARIES if known.lower() == name.strip().lower()), name)


def check_dictionary(name: str, markers: int) -> None:
    """Refuse a dictionary that OpenCV does not have, or one with fewer markers than a board needs."""
    if name not in DICTIONARIES:
        raise InvalidInput(f"There is no dictionary {name!r}; there are {', '.join(DICTIONARIES)}.")
    if markers > DICTIONARIES[name][1]:
        raise InvalidInput(f"{name} has {DICTIONARIES[name][1]} markers, the board needs {markers}.")


def marker_bits(name: str, ids: Indices) -> NDArray[np.bool_]:
    """(M, n, n) bits of markers without their border, row by row downwards; True is white."""
    dictionary, size = _dictionary(name), DICTIONARIES[name][0]
    bits = [_ARUCO.Dictionary_getBitsFromByteList(dictionary.bytesList[i : i + 1], size) for i in ids]
    return np.array(bits, dtype=bool).reshape(-1, size, size)


def find_markers(grey: GreyImage, name: str, border_bits: int = 1) -> Markers:
    """Find the markers of a dictionary, their corners to about a pixel.

    Parameters
    ----------
    grey : (H, W) array of uint8 or uint16
    name : str
        One of `DICTIONARIES`.
    border_bits : int
        Width of the black border in bits.

    Raises
    ------
    InvalidInput
        When this OpenCV has no aruco module.
    """
    image = _eight_bit(grey)
    dictionary = _dictionary(name)
    parameters = _parameters(max(grey.shape), DICTIONARIES[name][0] + 2 * border_bits, border_bits)
    if hasattr(_ARUCO, "ArucoDetector"):
        found = _ARUCO.ArucoDetector(dictionary, parameters).detectMarkers(image)
    else:
        found = _ARUCO.detectMarkers(image, dictionary, parameters=parameters)
    corners, ids, candidates = found
    return Markers(
        np.array([] if ids is None else ids, dtype=np.intp).ravel(),
        np.array(corners, dtype=np.float64).reshape(-1, 4, 2),
        np.array(candidates, dtype=np.float64).reshape(-1, 4, 2),
    )


def recognise(grey: GreyImage, quads: Array, border_bits: int = 1) -> str | None:
    """Name the dictionary that most of some dark quadrangles belong to, all bits being read.

    Parameters
    ----------
    grey : (H, W) array
    quads : (K, 4, 2)
        Their corners, pixels, one after the other.
    border_bits : int
        Width of the black border in bits.
    """
    hits = dict.fromkeys(DICTIONARIES, 0)
    for size in {size for size, _ in DICTIONARIES.values()}:
        codes = _read(grey, quads, size, border_bits).tolist()
        for name in hits:
            if DICTIONARIES[name][0] == size and hasattr(_ARUCO, name):
                hits[name] = sum(code in _codes(name) for code in codes)
    best = max(hits, key=lambda name: hits[name])  # of several that have them all the smallest comes first
    return best if hits[best] >= MIN_RECOGNISED else None


def _read(grey: GreyImage, quads: Array, size: int, border_bits: int) -> Indices:
    """Codes of the quadrangles that have a black border about size x size bits."""
    if len(quads) == 0:
        return np.empty(0, dtype=np.intp)
    cells = size + 2 * border_bits
    levels = sample(grey, map_grid(quads, (np.arange(cells) + 0.5) / cells))
    middle = (levels.max(axis=(1, 2)) + levels.min(axis=(1, 2))) / 2
    white = levels > middle[:, None, None]
    inner = white[:, border_bits:-border_bits, border_bits:-border_bits]
    return _code(inner[white.sum(axis=(1, 2)) == inner.sum(axis=(1, 2))])


def _code(bits: NDArray[np.bool_]) -> Indices:
    """Numbers whose binary digits are the bits (..., n, n)."""
    count = bits.shape[-1] ** 2
    return bits.reshape(*bits.shape[:-2], count) @ (1 << np.arange(count, dtype=np.intp))


@lru_cache(maxsize=len(DICTIONARIES))
def _codes(name: str) -> frozenset[int]:
    """Codes of all markers of a dictionary, each turned four ways."""
    bits = marker_bits(name, np.arange(DICTIONARIES[name][1]))
    turned = [_code(np.rot90(bits, turn, axes=(1, 2))) for turn in range(4)]
    return frozenset(np.concatenate(turned).tolist())


def find_board_markers(grey: GreyImage, name: str, border_bits: int, count: int, extent: float) -> Markers:
    """Find the markers of a board: where there are some but not all, and they are small, more closely.

    Parameters
    ----------
    grey, name, border_bits
        See :func:`find_markers`.
    count : int
        How many markers the board has.
    extent : float
        Its longer side, in edges of a marker.
    """
    found = find_markers(grey, name, border_bits)
    edges = np.linalg.norm(found.corners[:, 1] - found.corners[:, 0], axis=1)
    if not 0 < len(found) < count or np.median(edges) > SMALL_MARKER_PX:
        return found
    points, margin = found.corners.reshape(-1, 2), extent * float(np.median(edges))
    left, top = np.maximum(points.min(axis=0) - margin, 0).astype(int)
    right, bottom = (points.max(axis=0) + margin).astype(int)
    crop = _eight_bit(grey)[top:bottom, left:right]
    doubled = cv2.resize(crop, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    more = find_markers(np.asarray(doubled, np.uint8), name, border_bits)
    if len(more) <= len(found):
        return found
    middle = np.array([left, top]) - 0.25  # of the first pixel of the doubled image
    return Markers(more.ids, more.corners / 2 + middle, more.candidates / 2 + middle)


def _eight_bit(grey: GreyImage) -> NDArray[np.uint8]:
    if grey.dtype == np.uint8:
        return np.asarray(grey, np.uint8)
    return np.asarray(cv2.convertScaleAbs(grey, alpha=255 / max(1, int(grey.max()))), np.uint8)


@lru_cache(maxsize=8)
def _dictionary(name: str) -> Any:
    code = getattr(_ARUCO, name, None)
    if code is None:
        raise InvalidInput(
            f"OpenCV {cv2.__version__} as it is installed has no markers of {name}; install "
            "opencv-python-headless 4.7 or later, or the package with contrib in its name."
        )
    return _ARUCO.getPredefinedDictionary(code)


def _parameters(image_px: int, cells: int, border_bits: int) -> Any:
    create = getattr(_ARUCO, "DetectorParameters_create", None) or _ARUCO.DetectorParameters
    parameters = create()
    parameters.markerBorderBits = border_bits
    smallest = 4 * cells * MIN_BIT_PX / image_px
    parameters.minMarkerPerimeterRate = min(parameters.minMarkerPerimeterRate, smallest)
    return parameters
