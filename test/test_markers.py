from __future__ import annotations

import numpy as np
import pytest
from marker_pictures import CHARUCO, marker_picture, needs_markers

from fewcal import markers
from fewcal.errors import InvalidInput
from fewcal.markers import (
    DICTIONARIES,
    check_dictionary,
    find_dictionary,
    marker_bits,
    read_levels,
    read_markers,
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
    with pytest.raises(InvalidInput, match="no dictionary"):
        check_dictionary(["DICT_4X4_50"], 1)  # type: ignore[arg-type]


def test_an_opencv_without_markers_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    markers._dictionary.cache_clear()
    monkeypatch.setattr(markers, "_ARUCO", None)
    with pytest.raises(InvalidInput, match=r"has no markers of DICT_5X5_100; install a later opencv.*\."):
        marker_bits("DICT_5X5_100", np.arange(3))


def levels_of(ids: np.ndarray, name: str, border: int, turn: int = 0) -> np.ndarray:
    bits = np.rot90(marker_bits(name, ids), turn, axes=(1, 2))
    return 40.0 + 150 * np.pad(bits, ((0, 0), (border, border), (border, border)))


@needs_markers
@pytest.mark.parametrize("turn", range(4))
@pytest.mark.parametrize(("name", "border"), [("DICT_5X5_100", 1), ("DICT_APRILTAG_36h11", 2)])
def test_markers_are_told_however_they_are_turned(name: str, border: int, turn: int) -> None:
    ids = np.array([0, 7, 29])
    found, turns = read_markers(levels_of(ids, name, border, turn), name)
    np.testing.assert_array_equal(found, ids)
    np.testing.assert_array_equal(turns, turn)


@needs_markers
def test_a_wrong_bit_is_put_right_and_a_bright_border_is_not() -> None:
    levels = levels_of(np.array([4, 4, 4]), "DICT_5X5_100", 1)
    levels[1, 3, 3] = 230 - levels[1, 3, 3]
    levels[2, 0] = 190
    found, _ = read_markers(levels, "DICT_5X5_100")
    assert found.tolist() == [4, 4, -1]
    assert read_markers(levels[:0], "DICT_5X5_100")[0].shape == (0,)


@needs_markers
@pytest.mark.parametrize("name", DICTIONARIES)
def test_wrong_bits_are_put_right_as_far_as_markers_differ(name: str) -> None:
    if not hasattr(markers._ARUCO, name) or DICTIONARIES[name][1] > 600:
        return
    bits = marker_bits(name, np.arange(DICTIONARIES[name][1]))
    turned = np.concatenate([np.rot90(bits, turn, axes=(1, 2)) for turn in range(4)]).reshape(
        -1, bits[0].size
    )
    differing = (bits.reshape(len(bits), 1, -1) != turned).sum(axis=2)
    np.fill_diagonal(differing, bits[0].size)
    assert markers._correctable(name) == max(differing.min() - 1, 0) // 2


@needs_markers
@pytest.mark.parametrize("roll", [0, 90, 215])
def test_bits_are_read_in_squares(roll: float) -> None:
    image, true = marker_picture(CHARUCO, 48, 30, 40, roll)
    square = true[[1, 2, 8, 7]]  # the corners of the second row's first white square that is not at the rim
    found, turns = read_markers(read_levels(image, square[None], 7, 0.125), CHARUCO.dictionary)
    assert (found.tolist(), turns.tolist()) == ([4], [0])
    found, turns = read_markers(read_levels(image, square[None, [1, 2, 3, 0]], 7, 0.125), CHARUCO.dictionary)
    assert (found.tolist(), turns.tolist()) == ([4], [1])
    assert read_levels(image, square[None][:0], 7).shape == (0, 7, 7)


@needs_markers
def test_the_dictionary_of_other_markers_is_named() -> None:
    image, true = marker_picture(CHARUCO, 48, 30, 40, 10)
    squares = true.reshape(4, 6, 2)
    quads = np.stack([squares[:-1, :-1], squares[:-1, 1:], squares[1:, 1:], squares[1:, :-1]], axis=2)
    quads = quads.reshape(-1, 4, 2)
    assert recognise(image, quads, 1, 0.125) == "DICT_5X5_50"
    assert recognise(image, quads[:0], 1, 0.125) is None
    assert recognise(np.full_like(image, 128), quads, 1, 0.125) is None
