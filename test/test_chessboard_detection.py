from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from board_pictures import BOARD, CAMERA, SIZE, picture, pose
from hypothesis import given, settings
from hypothesis import strategies as st

from fewcal.boards import Chessboard
from fewcal.camera import Camera
from fewcal.detection import detect, detect_board
from fewcal.errors import BoardNotFound, InvalidInput
from fewcal.rendering import clutter, render

REAL = os.environ.get("FEWCAL_REAL_DATA")
REAL_SETS = (
    "limh_ceres",
    "opencv_left",
    "opencv_right",
    "udacity_carnd",
    "visp_eye_in_hand",
    "yz_eye_in_hand",
)


def rms(found: Any, true: Any) -> float:
    return float(np.sqrt(np.mean((np.asarray(found) - true) ** 2)))


def refusal(image: Any, board: Chessboard = BOARD) -> BoardNotFound:
    with pytest.raises(BoardNotFound) as caught:
        detect(image, board)
    assert caught.value.reason in BoardNotFound.REASONS
    assert str(caught.value).endswith(".")
    return caught.value


@settings(max_examples=25)
@given(
    tilt=st.floats(0, 50),
    about=st.floats(0, 360),
    roll=st.floats(-180, 180),
    square=st.floats(12, 36),
)
def test_corners_are_found_in_the_order_of_the_board_however_it_is_turned(
    tilt: float, about: float, roll: float, square: float
) -> None:
    image, true = picture(pose(BOARD, square, tilt, about, roll))
    view = detect(image, BOARD, source="camera", stamp_ns=7)
    assert rms(view.image_points, true) < 0.05
    np.testing.assert_array_equal(view.object_points, BOARD.points)
    assert (view.source, view.stamp_ns) == ("camera", 7)
    assert view.sigma is not None


@pytest.mark.parametrize("turn_deg", [10, 100, 190, 280])
@pytest.mark.parametrize(("columns", "rows"), [(7, 5), (6, 4), (6, 6), (7, 7), (4, 7), (3, 3)])
def test_every_kind_of_symmetry_has_one_order(columns: int, rows: int, turn_deg: float) -> None:
    board = Chessboard(columns, rows, 0.025)
    image, true = picture(pose(board, 25, 20, 30, turn_deg), board)
    found = detect(image, board).image_points
    first = np.argmin(np.abs(true - found[0]).max(axis=1))
    grid = true.reshape(rows, columns, 2)
    turns = [np.rot90(grid, k).reshape(-1, 2) for k in range(4) if np.rot90(grid, k).shape == grid.shape]
    assert min(rms(found, turn) for turn in turns) < 0.05
    if (columns - rows) % 2:
        assert first == 0  # the black corner square of the renderer's board lies beyond its first corner
    elif columns != rows or columns % 2 == 0:
        assert found[0].sum() == pytest.approx(min(turn[0].sum() for turn in turns), abs=0.1)
    else:
        black = [turn for turn in turns if any((turn[0] == end).all() for end in (grid[0, 0], grid[-1, -1]))]
        assert found[0].sum() == pytest.approx(min(turn[0].sum() for turn in black), abs=0.1)


def test_the_same_image_gives_the_same_view() -> None:
    image, _ = picture(pose(BOARD, 30, 20, 40, 15))
    np.testing.assert_array_equal(detect(image, BOARD).image_points, detect(image, BOARD).image_points)


@pytest.mark.parametrize("kind", ["column", "bgr", "bgra", "uint16", "big endian", "12 bit", "strided"])
def test_any_grey_or_colour_image_serves(kind: str) -> None:
    image, true = picture(pose(BOARD, 30, 20, 40, 15))
    deep = image.astype(np.uint16)
    given_image = {
        "column": image[..., None],
        "bgr": np.dstack([image] * 3),
        "bgra": np.dstack([image] * 4),
        "uint16": deep * 257,
        "big endian": (deep * 257).astype(">u2"),
        "12 bit": deep * 16,
        "strided": np.repeat(image, 2, axis=1)[:, ::2],
    }[kind]
    assert rms(detect(given_image, BOARD).image_points, true) < 0.03


@pytest.mark.parametrize("square_px", [8, 12, 20, 60])
def test_the_window_follows_the_squares(square_px: float) -> None:
    camera = Camera(1000.0, 1000.0, 639.5, 479.5)
    T = pose(BOARD, square_px * 0.6, 15, 40, 20)  # a focal length 1000 / 600 times as long
    image, true = picture(T, camera=camera, size=(1280, 960))
    assert rms(detect(image, BOARD).image_points, true) < 0.05


@pytest.mark.parametrize("k1", [-0.3, 0.3])
def test_strong_distortion_is_no_reason_to_refuse(k1: float) -> None:
    camera = Camera(350.0, 350.0, 319.5, 239.5, np.array([k1, 0.1, 0.001, 0.001, 0.0]))
    image, true = picture(pose(BOARD, 55, 15, 40), camera=camera)
    assert rms(detect(image, BOARD).image_points, true) < 0.05


@pytest.mark.parametrize(
    "conditions",
    [{"blur_px": 2.0}, {"read_noise": 8.0}, {"light_slope": 0.8}, {"exposure": 1.6}, {"exposure": 0.1}],
    ids=str,
)
def test_corners_are_better_than_those_of_opencv(conditions: dict[str, float]) -> None:
    ours, theirs = [], []
    for seed, about in enumerate((20, 140, 260)):
        image, true = picture(pose(BOARD, 30, 25, about, 10), seed=seed, **conditions)
        ours.append(rms(detect(image, BOARD).image_points, true))
        found, corners = cv2.findChessboardCorners(image, (9, 6))
        assert found
        corners = cv2.cornerSubPix(image, corners, (11, 11), (-1, -1), (3, 40, 1e-3)).reshape(-1, 2)
        theirs.append(min(rms(corners, true), rms(corners[::-1], true)))
    assert np.median(ours) < 0.7 * np.median(theirs)


@pytest.mark.parametrize(("noise", "blur"), [(2.0, 1.0), (6.0, 1.0), (2.0, 3.0)])
def test_sigma_is_the_size_of_the_error(noise: float, blur: float) -> None:
    z = []
    for seed in range(5):
        image, true = picture(pose(BOARD, 30, 25, 70 * seed, 10), seed=seed, read_noise=noise, blur_px=blur)
        view = detect(image, BOARD)
        assert view.sigma is not None
        z.append((view.image_points - true) / view.sigma[:, None])
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.3


def test_edge_width_measures_blur_and_motion() -> None:
    T = pose(BOARD, 36, 20, 40)
    sharp = detect_board(picture(T, blur_px=0.7)[0], BOARD)
    soft = detect_board(picture(T, blur_px=2.0)[0], BOARD)
    moving = detect_board(picture(T, blur_px=0.7, motion_px=8.0)[0], BOARD)
    assert sharp.edge_width_px == pytest.approx(2.563 * np.hypot(0.7, 12**-0.5), rel=0.05)
    assert soft.edge_width_px == pytest.approx(2.563 * np.hypot(2.0, 12**-0.5), rel=0.05)
    assert 5 < moving.edge_width_px < 9
    assert sharp.sharpness > soft.sharpness > moving.sharpness
    assert sharp.square_px == pytest.approx(36, rel=0.15)


@pytest.mark.parametrize(
    ("asked", "sentence"),
    [
        ((10, 7), "Found 9x6 interior corners where 10x7 were asked for; a board of 10x7 squares has 9x6"),
        ((7, 10), "Found 6x9 interior corners where 7x10 were asked for; a board of 7x10 squares has 6x9"),
        ((8, 6), "Found 9x6 interior corners where 8x6 were asked for"),
        ((7, 4), "Found 9x6 interior corners where 7x4 were asked for"),
    ],
)
def test_a_board_of_another_size_is_told_with_its_size(asked: tuple[int, int], sentence: str) -> None:
    image, _ = picture(pose(BOARD, 30, 20, 40, 15))
    error = refusal(image, Chessboard(*asked, 0.025))
    assert error.reason == "wrong size"
    assert sentence in str(error)


@pytest.mark.parametrize("shift", [(230.0, 0.0), (300.0, 0.0), (0.0, 190.0)])
def test_a_board_beyond_the_border_is_cut_off(shift: tuple[float, float]) -> None:
    image, _ = picture(pose(BOARD, 30, 20, 40, 5, shift))
    assert refusal(image).reason == "cut off"


def test_covered_corners_are_not_invented() -> None:
    image, true = picture(pose(BOARD, 36, 20, 40, 15))
    for corner in (0, 4, 22):
        covered = cv2.circle(image.copy(), np.rint(true[corner]).astype(int).tolist(), 14, 255, -1)
        error = refusal(covered)
        assert error.reason == "cut off"
        assert "1 of the 54 corners" in str(error)


@pytest.mark.parametrize("conditions", [{"blur_px": 9.0}, {"motion_px": 20.0}], ids=str)
def test_a_blurred_board_is_said_to_be_blurred(conditions: dict[str, float]) -> None:
    image, _ = picture(pose(BOARD, 36, 20, 40, 15), **conditions)
    assert refusal(image).reason == "blurred"


def test_corners_of_no_plane_are_refused() -> None:
    image, true = picture(pose(BOARD, 36, 10, 40, 5))
    y, x = np.mgrid[: SIZE[1], : SIZE[0]].astype(np.float32)
    bump = 6 * np.exp(-((x - true[22, 0]) ** 2 + (y - true[22, 1]) ** 2) / 2 / 18**2)
    error = refusal(cv2.remap(image, (x - bump).astype(np.float32), y, cv2.INTER_CUBIC))
    assert error.reason == "not planar"


def nothing(name: str) -> Any:
    rng = np.random.default_rng(3)
    return {
        "black": np.zeros((480, 640), np.uint8),
        "saturated": np.full((480, 640, 3), 255, np.uint8),
        "noise": rng.integers(0, 256, (480, 640)).astype(np.uint8),
        "deep noise": rng.integers(0, 65536, (480, 640)).astype(np.uint16),
        "one pixel": np.zeros((1, 1), np.uint8),
        "two rows": rng.integers(0, 256, (2, 900)).astype(np.uint8),
        "flat": rng.integers(0, 256, (20, 20000)).astype(np.uint8),
        "narrow": rng.integers(0, 256, (20000, 20, 3)).astype(np.uint8),
        "stripes": ((np.indices((480, 640))[0] // 8 % 2) * 255).astype(np.uint8),
        "pixel checks": ((np.indices((480, 640)).sum(axis=0) % 2) * 255).astype(np.uint8),
        "clutter": render(CAMERA, SIZE, None, None, background=clutter(SIZE, rng)),
        "circles": circles(),
    }[name]


def circles() -> Any:
    image = np.full((480, 640), 220, np.uint8)
    for y in range(60, 420, 40):
        for x in range(60, 600, 40):
            cv2.circle(image, (x, y), 14, 30, -1, cv2.LINE_AA)
    return image


@pytest.mark.parametrize(
    "name",
    [
        "black",
        "saturated",
        "noise",
        "deep noise",
        "one pixel",
        "two rows",
        "flat",
        "narrow",
        "stripes",
        "pixel checks",
        "clutter",
        "circles",
    ],
)
def test_where_no_board_is_none_is_found(name: str) -> None:
    assert refusal(nothing(name)).reason == "no board"


@pytest.mark.parametrize(
    "image",
    [
        np.full((50, 50), np.nan),
        np.zeros((50, 50), np.int16),
        np.zeros((50, 50), bool),
        np.zeros((0, 9), np.uint8),
        np.zeros((50, 50, 2), np.uint8),
        np.zeros(50, np.uint8),
        [[0, 1], [1, 0]],
        "image.png",
        None,
    ],
    ids=lambda image: f"{getattr(image, 'dtype', type(image).__name__)} {getattr(image, 'shape', '')}",
)
def test_what_is_no_image_is_refused(image: Any) -> None:
    with pytest.raises(InvalidInput, match=r"An image must .*\.$"):
        detect(image, BOARD)


def test_a_board_among_clutter_is_found() -> None:
    T = pose(BOARD, 25, 20, 40, 15)
    image = render(CAMERA, SIZE, BOARD, T, background=clutter(SIZE, np.random.default_rng(1)))
    assert rms(detect(image, BOARD).image_points, CAMERA.project(BOARD.points, T)) < 0.03


def test_a_mirror_image_is_a_view_of_a_board() -> None:
    image, true = picture(pose(BOARD, 30, 20, 40, 15))
    found = detect(image[:, ::-1], BOARD).image_points
    mirrored = np.column_stack([SIZE[0] - 1 - true[:, 0], true[:, 1]]).reshape(6, 9, 2)
    assert rms(found, mirrored[::-1].reshape(-1, 2)) < 0.03


@pytest.mark.skipif(not REAL, reason="FEWCAL_REAL_DATA is not set")
@pytest.mark.parametrize("name", REAL_SETS)
def test_no_real_board_that_opencv_finds_is_missed(name: str) -> None:
    folder = Path(str(REAL)) / "sets" / name
    columns, rows = json.loads((folder / "meta.json").read_text())["inner_corners"]
    board = Chessboard(columns, rows, 1.0)
    reference = np.load(folder / "corners.npz")
    differences = []
    for view, image_name in enumerate(reference["names"].astype(str)):
        image = cv2.imread(str(folder / "images" / image_name))
        if image is None:
            continue
        found = detect(image, board).image_points
        theirs = reference["img"][reference["view_ptr"][view] : reference["view_ptr"][view + 1]]
        same = min((theirs, theirs[::-1]), key=lambda corners: rms(found, corners))
        differences.append(np.linalg.norm(found - same, axis=1))
    assert len(differences) >= 6
    assert np.median(np.concatenate(differences)) < 0.15
    assert np.percentile(np.concatenate(differences), 95) < 0.4


@pytest.mark.skipif(not REAL, reason="FEWCAL_REAL_DATA is not set")
@pytest.mark.parametrize("name", ["calibration1.jpg", "calibration5.jpg"])
def test_real_boards_beyond_the_border_are_cut_off(name: str) -> None:
    image = cv2.imread(str(Path(str(REAL)) / "sets" / "udacity_carnd" / "images" / name))
    assert refusal(image).reason == "cut off"
