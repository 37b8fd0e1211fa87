from __future__ import annotations

import json
import os
from dataclasses import fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from board_pictures import BOARD, CAMERA, SIZE, picture, pose
from hypothesis import given, settings
from hypothesis import strategies as st
from no_board import NO_BOARD, no_board

from fewcal.boards import Chessboard
from fewcal.camera import Camera
from fewcal.chessboard_detection import _find_corners, _goes_on
from fewcal.corner_refinement import RefinedCorners
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


@pytest.mark.parametrize("conditions", [{"blur_px": 12.0}, {"motion_px": 40.0}], ids=str)
def test_a_blurred_board_is_said_to_be_blurred(conditions: dict[str, float]) -> None:
    image, _ = picture(pose(BOARD, 36, 20, 40, 15), **conditions)
    assert refusal(image).reason == "blurred"


@pytest.mark.parametrize("blur_px", [0.7, 3.0])
@pytest.mark.parametrize("tilt", [0.0, 45.0])
def test_a_part_of_a_board_is_told_from_the_whole(blur_px: float, tilt: float) -> None:
    image, _ = picture(pose(BOARD, 30.0, tilt, 20.0), blur_px=blur_px)
    whole = _find_corners(image, BOARD)
    assert not _goes_on(image, whole)
    for part in (np.s_[:, :-1], np.s_[:, 1:], np.s_[:-1], np.s_[1:], np.s_[1:-1, 1:-1]):
        assert _goes_on(image, RefinedCorners(*(getattr(whole, of.name)[part] for of in fields(whole))))


@pytest.mark.skipif(not REAL, reason="FEWCAL_REAL_DATA is not set")
def test_no_part_of_a_real_board_is_taken_for_one() -> None:
    smaller, found = Chessboard(8, 6, 0.025), 0
    for name in ("opencv_left", "opencv_right"):
        for path in sorted(Path(str(REAL), "sets", name, "images").iterdir()):
            image = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
            whole = detect(image, Chessboard(9, 6, 0.025)).image_points
            found += 1
            try:
                part = detect(image, smaller).image_points
            except BoardNotFound:
                continue
            # There is a monitor in the background that shows small boards.
            apart = np.linalg.norm(part[:, None] - whole, axis=2).min()
            assert apart > 50, path.name
    assert found == 26


def test_blur_that_leaves_every_corner_is_no_reason_to_refuse() -> None:
    z = []
    for seed in range(4):
        image, true = picture(
            pose(BOARD, 18, 20, 70 * seed, 10), seed=seed, blur_px=4.2
        )  # edges: 0.6 squares
        view = detect(image, BOARD)
        assert view.sigma is not None
        z.append((view.image_points - true) / view.sigma[:, None])
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.3


@pytest.mark.parametrize("motion_deg", [45.0, 135.0])
def test_motion_along_a_diagonal_joins_squares_but_hides_no_board(motion_deg: float) -> None:
    image, true = picture(pose(BOARD, 30, 20, 40, 5), motion_px=15.0, motion_deg=motion_deg)
    assert rms(detect(image, BOARD).image_points, true) < 0.3


@pytest.mark.parametrize("row", [0, 5])
def test_a_shadow_along_an_outer_row_hides_no_board(row: int) -> None:
    image, true = picture(pose(BOARD, 30, 5, 40, 0))
    y = np.arange(SIZE[1])[:, None]
    edge = true[9 * row : 9 * row + 9, 1].mean() + (4 if row else -4)
    shadow = np.where((y > edge) == bool(row), 0.2, 1.0)
    found = detect((image * shadow).astype(np.uint8), BOARD).image_points
    assert np.abs(found - true).max() < 1.5  # a sharp shadow draws the corners beside it towards itself


def test_a_tiled_floor_behind_hides_no_board() -> None:
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    tiles = 0.35 + 0.3 * ((x // 42 + y // 42) % 2)
    for roll in (0, 10, 20, 30, 40):
        T = pose(BOARD, 27, 20, 40, roll)
        image = render(CAMERA, SIZE, BOARD, T, background=tiles)
        assert rms(detect(image, BOARD).image_points, CAMERA.project(BOARD.points, T)) < 0.05


def test_of_two_boards_the_one_of_the_size_is_found() -> None:
    other = Chessboard(5, 4, 0.025)
    left, right = (pose(BOARD, 22, 10, 40, 5, (-150, 60)), pose(other, 40, 10, 40, 5, (140, -60)))
    image, true = picture(left)
    with_both = render(CAMERA, SIZE, other, right, background=image / 255)
    assert rms(detect(with_both, BOARD).image_points, true) < 0.1
    assert rms(detect(with_both, other).image_points, CAMERA.project(other.points, right)) < 0.1


def test_of_two_boards_of_one_size_one_is_found_whole() -> None:
    poses = [pose(BOARD, 22, 10, 40, 5, (-160, 60)), pose(BOARD, 25, 10, 40, 25, (150, -60))]
    image, _ = picture(poses[0])
    image = render(CAMERA, SIZE, BOARD, poses[1], background=image / 255)
    found = detect(image, BOARD).image_points
    assert min(rms(found, CAMERA.project(BOARD.points, T)) for T in poses) < 0.1


@pytest.mark.parametrize("strength", [100, 200, 400])
def test_glare_gives_right_corners_or_none(strength: float) -> None:
    image, true = picture(pose(BOARD, 36, 20, 40, 15))
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    for u, v in true[[0, 12, 31, 53]]:
        lamp = strength * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 50**2))
        glaring = np.clip(image + lamp, 0, 255).astype(np.uint8)
        try:
            found = detect(glaring, BOARD).image_points
        except BoardNotFound as error:
            assert error.reason in ("cut off", "not planar")  # noqa: PT017
        else:
            assert np.abs(found - true).max() < 1.0


def test_motion_during_the_readout_shears_a_board_and_vibration_is_refused() -> None:
    image, true = picture(pose(BOARD, 36, 20, 40, 15))
    x, y = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in SIZE))

    def shaken(offset: Any) -> Any:
        return cv2.remap(image, (x - offset).astype(np.float32), y, cv2.INTER_CUBIC)

    panned = detect(shaken(40 * y / SIZE[1]), BOARD).image_points
    assert rms(panned, true + np.column_stack([40 * true[:, 1] / SIZE[1], np.zeros(len(true))])) < 0.1
    vibrating = shaken(6 * np.sin(8 * np.pi * y / SIZE[1]))
    assert refusal(vibrating).reason in ("not planar", "cut off")


def test_corners_of_no_plane_are_refused() -> None:
    image, true = picture(pose(BOARD, 36, 10, 40, 5))
    y, x = np.mgrid[: SIZE[1], : SIZE[0]].astype(np.float32)
    bump = 6 * np.exp(-((x - true[22, 0]) ** 2 + (y - true[22, 1]) ** 2) / 2 / 18**2)
    error = refusal(cv2.remap(image, (x - bump).astype(np.float32), y, cv2.INTER_CUBIC))
    assert error.reason == "not planar"


def test_circles_are_none() -> None:
    image = np.full((480, 640), 220, np.uint8)
    for y in range(60, 420, 40):
        for x in range(60, 600, 40):
            cv2.circle(image, (x, y), 14, 30, -1, cv2.LINE_AA)
    assert refusal(image).reason == "no board"


@pytest.mark.parametrize("name", NO_BOARD)
def test_where_no_board_is_none_is_found(name: str) -> None:
    assert refusal(no_board(name)).reason == "no board"


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
