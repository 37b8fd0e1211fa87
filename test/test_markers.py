from __future__ import annotations

import numpy as np
import pytest
from marker_pictures import CHARUCO, marker_picture, needs_markers

from fewcal import markers
from fewcal.errors import InvalidInput
from fewcal.markers import (
    DICTIONARIES,
    check_dictionary,
    find_board_markers,
    find_dictionary,
    find_markers,
    marker_bits,
    recognise,
)


@needs_markers
@pytest.mark.parametrize("name", DICTIONARIES)
def test_every_dictionary_is_as_large_as_it_says(name: str) -> None:
    size, count = DICTIONARIES[name]
    if not hasattr(markers._ARUCO, name):
        with pytest.raises(InvalidInput, match=f"has no markers of {name}; install"):
            marker_bits(name, np.arange(count))
        return
    bits = marker_bits(name, np.arange(count))
    assert bits.shape == (count, size, size)
    assert len(np.unique(bits.reshape(count, -1), axis=0)) == count


@needs_markers
@pytest.mark.parametrize(("family", "code"), [("36h11", 0xD5D628584), ("25h9", 0x155CBF1), ("16h5", 0x231B)])
def test_tags_are_upside_down_in_opencv(family: str, code: int) -> None:
    """The code of tag 0 of each family, from the AprilTag library: its first bit is the upper left one."""
    bits = marker_bits(f"DICT_APRILTAG_{family}", np.array([0]))[0]
    upright = np.rot90(bits, 2).ravel()
    assert int("".join("01"[bit] for bit in upright.astype(int)), 2) == code


def test_dictionaries_are_found_however_they_are_written() -> None:
    assert find_dictionary(" dict_apriltag_36H11 ") == "DICT_APRILTAG_36h11"
    assert find_dictionary("DICT_9X9") == "DICT_9X9"
    check_dictionary("DICT_4X4_50", 50)
    with pytest.raises(InvalidInput, match="DICT_4X4_50 has 50 markers, the board needs 51"):
        check_dictionary("DICT_4X4_50", 51)
    with pytest.raises(InvalidInput, match="no dictionary 'DICT_9X9'; there are DICT_4X4_50"):
        check_dictionary("DICT_9X9", 1)


def test_an_opencv_without_markers_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    markers._dictionary.cache_clear()
    monkeypatch.setattr(markers, "_ARUCO", None)
    with pytest.raises(InvalidInput, match=r"has no markers of DICT_5X5_100; install opencv.*\."):
        find_markers(np.zeros((480, 640), np.uint8), "DICT_5X5_100")


@needs_markers
@pytest.mark.parametrize("roll", [0, 90, 215])
def test_markers_are_found_with_their_corners_in_order(roll: float) -> None:
    image, true = marker_picture(CHARUCO, 48, 30, 40, roll)
    found = find_markers(image, CHARUCO.dictionary)
    assert len(found) >= 16
    # The interior corners about marker 4, in the second row of squares, are numbers 1, 2, 8 and 7.
    around = true[[1, 2, 8, 7]]
    corners = found.corners[found.ids == 4][0]
    np.testing.assert_allclose(corners, around + 0.125 * (around[[2, 3, 0, 1]] - around), atol=3.0)
    assert len(found.take(found.ids < 5)) == 5


@needs_markers
def test_the_dictionary_of_other_markers_is_named() -> None:
    image, _ = marker_picture(CHARUCO, 48, 30, 40, 10)
    found = find_markers(image, "DICT_4X4_1000")
    assert recognise(image, found.candidates) == "DICT_5X5_50"
    assert recognise(image, found.candidates[:0]) is None
    assert recognise(np.full_like(image, 128), found.candidates) is None


@needs_markers
def test_small_markers_are_looked_at_twice() -> None:
    image, true = marker_picture(CHARUCO, 20, 20, 40, 10)
    once = find_markers(image, CHARUCO.dictionary)
    twice = find_board_markers(image, CHARUCO.dictionary, 1, CHARUCO.marker_count, 9.4)
    assert len(once) <= len(twice)
    marker = int(twice.ids[0])
    np.testing.assert_allclose(twice.corners[0].mean(axis=0), markers_at(true, marker), atol=1.0)
    nothing = find_board_markers(np.full_like(image, 128), CHARUCO.dictionary, 1, CHARUCO.marker_count, 9.4)
    assert len(nothing) == 0


def markers_at(true: np.ndarray, marker: int) -> np.ndarray:
    """Middle of a marker in the image, from the corners of the board next to it."""
    away = np.linalg.norm(CHARUCO.points[:, :2] - CHARUCO.marker_corners[marker].mean(axis=0), axis=1)
    near = np.argsort(away)[:8]
    plane = np.column_stack([CHARUCO.points[near, :2], np.ones(8)])
    affine, *_ = np.linalg.lstsq(plane, true[near], rcond=None)
    return np.append(CHARUCO.marker_corners[marker].mean(axis=0), 1.0) @ affine
