from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from board_pictures import BOARD, CAMERA, SIZE, picture, pose
from marker_pictures import (
    CHARUCO,
    REAL,
    errors,
    indices,
    marker_picture,
    needs_markers,
    real_views,
)

from fewcal.boards import Charuco, parse_board
from fewcal.camera import Camera
from fewcal.errors import BoardNotFound
from fewcal.rendering import Conditions, clutter, render

pytestmark = needs_markers


def refusal(image: Any, board: Charuco = CHARUCO) -> BoardNotFound:
    with pytest.raises(BoardNotFound) as caught:
        board.detect(image)
    assert caught.value.reason in BoardNotFound.REASONS
    assert str(caught.value).endswith(".")
    return caught.value


@pytest.mark.parametrize("roll", [0, 100, 185, 275])
@pytest.mark.parametrize("tilt", [0, 30, 55])
def test_every_corner_is_found_in_the_order_of_the_board(tilt: float, roll: float) -> None:
    image, true = marker_picture(CHARUCO, 48, tilt, 40, roll)
    found = CHARUCO.detect(image, source="camera", stamp_ns=7)
    np.testing.assert_array_equal(indices(CHARUCO, found), np.arange(24))
    assert np.abs(errors(CHARUCO, found, true)).max() < 0.05
    assert (found.view.source, found.view.stamp_ns) == ("camera", 7)
    assert found.edge_width_px == pytest.approx(2.563 * np.hypot(0.7, 12**-0.5), rel=0.2)
    assert 47 * np.cos(np.radians(tilt)) < found.square_px < 50


@pytest.mark.parametrize(
    "text",
    [
        "charuco:5x7:0.04:0.03:DICT_4X4_50",
        "charuco:8x6:0.03:0.02:DICT_6X6_250",
        "charuco:8x6:0.03:0.02:DICT_6X6_250:legacy",
        "charuco:6x4:0.03:0.025:DICT_7X7_50",
        "charuco:4x3:0.04:0.02:DICT_ARUCO_ORIGINAL",
        "charuco:7x5:0.04:0.03:DICT_APRILTAG_36h11",
    ],
)
def test_any_size_and_dictionary_serves(text: str) -> None:
    board: Any = parse_board(text)
    image, true = marker_picture(board, 50, 25, 20, 10)
    found = board.detect(image)
    assert len(found.view) == len(board.points)
    assert np.abs(errors(board, found, true)).max() < 0.06


@pytest.mark.parametrize("shift", [(230.0, 0.0), (-250.0, 60.0), (0.0, -180.0), (200.0, 150.0)])
def test_a_part_of_the_board_is_enough(shift: tuple[float, float]) -> None:
    image, true = marker_picture(CHARUCO, 70, 30, 60, 10, shift)
    found = CHARUCO.detect(image)
    seen = np.all((true > 1.9) & (true < np.array(SIZE) - 2.9), axis=1)
    assert 6 <= len(found.view) < 24
    assert seen[indices(CHARUCO, found)].all()
    assert len(found.view) >= 0.8 * seen.sum()
    assert np.abs(errors(CHARUCO, found, true)).max() < 0.05
    assert (np.diff(indices(CHARUCO, found)) > 0).all()


def test_covered_corners_are_left_out() -> None:
    image, true = marker_picture(CHARUCO, 48, 20, 40, 15)
    covered = cv2.circle(image.copy(), np.rint(true[9]).astype(int).tolist(), 20, 255, -1)
    found = CHARUCO.detect(covered)
    assert 9 not in indices(CHARUCO, found)
    assert len(found.view) >= 20
    assert np.abs(errors(CHARUCO, found, true)).max() < 0.05


@pytest.mark.parametrize("k1", [-0.3, 0.3])
def test_strong_distortion_is_no_reason_to_refuse(k1: float) -> None:
    camera = Camera(350.0, 350.0, 319.5, 239.5, np.array([k1, 0.1, 0.001, 0.001, 0.0]))
    image, true = marker_picture(CHARUCO, 110, 15, 40, camera=camera)
    found = CHARUCO.detect(image)
    assert len(found.view) == 24
    assert np.abs(errors(CHARUCO, found, true)).max() < 0.06


@pytest.mark.skipif(not hasattr(getattr(cv2, "aruco", None), "CharucoDetector"), reason="OpenCV before 4.7")
@pytest.mark.parametrize(
    ("share", "conditions"),
    [
        (0.5, {}),
        (0.5, {"blur_px": 1.5}),
        (0.5, {"read_noise": 6.0}),
        (0.5, {"light_slope": 0.8}),
        (0.9, {"exposure": 1.6}),  # white is saturated, and the markers shrink
    ],
    ids=str,
)
def test_corners_are_better_and_more_than_those_of_opencv(share: float, conditions: dict[str, float]) -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    detector = cv2.aruco.CharucoDetector(cv2.aruco.CharucoBoard((7, 5), 0.04, 0.03, dictionary))
    for about in (20, 140, 260):
        image, true = marker_picture(CHARUCO, 44, 25, about, 10, conditions=Conditions(**conditions))
        found = CHARUCO.detect(image)
        corners, ids, _, _ = detector.detectBoard(image)
        theirs = corners.reshape(-1, 2) - true[ids.ravel()]
        assert len(found.view) >= len(theirs)
        assert np.sqrt(np.mean(errors(CHARUCO, found, true) ** 2)) < share * np.sqrt(np.mean(theirs**2))


@pytest.mark.parametrize("square_px", [24, 34, 60])
@pytest.mark.parametrize(("noise", "blur"), [(2.0, 0.7), (6.0, 1.0)])
def test_sigma_is_the_size_of_the_error(noise: float, blur: float, square_px: float) -> None:
    z = []
    for about in range(0, 360, 60):
        conditions = Conditions(read_noise=noise, blur_px=blur)
        image, true = marker_picture(CHARUCO, square_px, 20, about, 10, conditions=conditions)
        found = CHARUCO.detect(image)
        assert found.view.sigma is not None
        z.append(errors(CHARUCO, found, true) / found.view.sigma[:, None])
    assert 0.7 < np.sqrt(np.mean(np.concatenate(z) ** 2)) < 1.3


@pytest.mark.parametrize(
    ("asked", "sentence"),
    [
        ({"columns": 8}, "as on a board 7 squares wide, not 8;"),
        ({"columns": 5, "rows": 7}, "as on a board 7 squares wide, not 5;"),
        (
            {"rows": 4},
            "Markers up to number 16 are seen, .* ends with 13; give the number of rows",
        ),
        ({"dictionary": "DICT_6X6_250"}, "The markers are those of DICT_5X5_50, not of DICT_6X6_250;"),
        ({"dictionary": "DICT_APRILTAG_25h9"}, "The markers are those of DICT_5X5_50, not of"),
    ],
)
def test_another_board_is_told(asked: dict[str, Any], sentence: str) -> None:
    image, _ = marker_picture(CHARUCO, 48, 20, 40, 15)
    error = refusal(image, replace(CHARUCO, **asked))
    assert error.reason == "wrong size"
    assert re.search(sentence, str(error))


@pytest.mark.parametrize("columns", [5, 6, 8, 9])
@pytest.mark.parametrize("blur", [2.0, 2.4, 2.8])
def test_a_blurred_board_of_another_width_is_not_taken_for_the_one_asked_for(
    columns: int, blur: float
) -> None:
    # Two legible markers of one row lie alike on boards of any width; the others do not look so.
    for turn in range(0, 360, 60):
        image, _ = marker_picture(CHARUCO, 34, 35, turn, 15, conditions=Conditions(blur_px=blur))
        assert refusal(image, replace(CHARUCO, columns=columns)).reason in ("wrong size", "no board")


@pytest.mark.parametrize(("printed", "hint"), [(True, "add :legacy"), (False, "leave :legacy away")])
def test_boards_printed_before_opencv_4_6_are_told(printed: bool, hint: str) -> None:
    board = Charuco(7, 6, 0.04, 0.03, "DICT_5X5_100", legacy=printed)
    image, _ = marker_picture(board, 48, 20, 40, 15)
    error = refusal(image, replace(board, legacy=not printed))
    assert error.reason == "wrong size"
    assert hint in str(error)


def test_too_few_corners_are_cut_off() -> None:
    image, _ = marker_picture(CHARUCO, 200, 5, 40, 0, (480, 280))
    error = refusal(image)
    assert error.reason == "cut off"
    assert "of the 24 corners" in str(error)


def test_a_bent_board_is_not_planar() -> None:
    image, _ = marker_picture(CHARUCO, 60, 10, 40, 5)
    y, x = np.mgrid[: SIZE[1], : SIZE[0]].astype(np.float32)
    wave = 10 * np.sin(x / 11) * np.sin(y / 13)
    error = refusal(cv2.remap(image, (x + wave).astype(np.float32), y, cv2.INTER_CUBIC))
    assert error.reason in ("not planar", "no board", "cut off", "blurred")


def test_a_board_among_clutter_is_found() -> None:
    T = pose(CHARUCO, 45, 20, 40, 15)
    image = render(CAMERA, SIZE, CHARUCO, T, background=clutter(SIZE, np.random.default_rng(1)))
    found = CHARUCO.detect(image)
    assert len(found.view) == 24
    assert np.abs(errors(CHARUCO, found, CAMERA.project(CHARUCO.points, T))).max() < 0.05


@pytest.mark.parametrize("deep", [1, 257])
def test_deep_images_serve(deep: int) -> None:
    image, true = marker_picture(CHARUCO, 48, 20, 40, 15)
    found = CHARUCO.detect(image.astype(np.uint16) * deep)
    assert np.abs(errors(CHARUCO, found, true)).max() < 0.05


@pytest.mark.skipif(not REAL, reason="FEWCAL_REAL_DATA is not set")
@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("rosi_charuco", "charuco:5x7:0.036195:0.018256:DICT_6X6_250"),
        ("yz_charuco_intr", "charuco:9x7:0.04:0.02:DICT_4X4_100"),
    ],
)
def test_real_boards_are_found_in_order_and_more_of_them_than_by_opencv(name: str, text: str) -> None:
    board = parse_board(text)
    for view, points, theirs in real_views(name, board):
        assert len(view) >= max(len(theirs), 0.9 * len(board.points))
        found = np.linalg.norm(view.object_points[:, None] - points, axis=2)
        assert found.min(axis=0).max() < 1e-6
        assert np.linalg.norm(view.image_points[found.argmin(axis=0)] - theirs, axis=1).max() < 1.5


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((480, 640), np.uint8),
        np.full((480, 640, 3), 255, np.uint8),
        np.random.default_rng(3).integers(0, 256, (480, 640)).astype(np.uint8),
        np.zeros((1, 1), np.uint8),
        np.zeros((2, 900), np.uint8),
        np.zeros((20, 20000), np.uint8),
        picture(pose(BOARD, 30, 20, 40, 15))[0],
        render(CAMERA, SIZE, None, None, background=clutter(SIZE, np.random.default_rng(3))),
    ],
    ids=["black", "saturated", "noise", "one pixel", "two rows", "flat", "chessboard", "clutter"],
)
def test_where_no_board_is_none_is_found(image: Any) -> None:
    assert refusal(image).reason == "no board"


def test_a_blurred_board_is_refused() -> None:
    image, _ = marker_picture(CHARUCO, 48, 20, 40, 15, conditions=Conditions(blur_px=6.0))
    assert refusal(image).reason in ("blurred", "no board")


@pytest.mark.parametrize(
    "dictionary", ["DICT_4X4_50", "DICT_4X4_1000", "DICT_6X6_250", "DICT_ARUCO_ORIGINAL"]
)
def test_a_board_in_a_mirror_is_told(dictionary: str) -> None:
    board = Charuco(6, 8, 0.04, 0.03, dictionary, legacy=True)
    image, _ = marker_picture(board, 40, 20, 40, 10)
    assert len(board.detect(image).view) == 35
    assert "in a mirror" in str(refusal(np.ascontiguousarray(image[:, ::-1]), board))
