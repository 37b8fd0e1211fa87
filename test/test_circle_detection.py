from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from board_pictures import BOARD, CAMERA, SIZE
from board_pictures import picture as chessboard_picture
from board_pictures import pose as chessboard_pose
from circle_pictures import ASYMMETRIC, BARREL, SYMMETRIC, picture, pose
from hypothesis import given, settings
from hypothesis import strategies as st
from no_board import NO_BOARD, no_board

from fewcal.boards import AsymmetricCircleGrid, CircleGrid
from fewcal.calibration import calibrate
from fewcal.detection import detect, detect_board
from fewcal.errors import BoardNotFound, InvalidInput
from fewcal.rendering import clutter
from fewcal.views import View

REAL = os.environ.get("FEWCAL_REAL_DATA")
KINDS = pytest.mark.parametrize("board", [SYMMETRIC, ASYMMETRIC], ids=str)


def rms(found: Any, true: Any) -> float:
    return float(np.sqrt(np.mean((np.asarray(found) - true) ** 2)))


def either_way(found: Any, true: Any) -> Any:
    """The truth in the order found, for boards that look the same turned by half."""
    return min(true, true[::-1], key=lambda order: rms(found, order))


def refusal(image: Any, board: CircleGrid | AsymmetricCircleGrid = SYMMETRIC) -> BoardNotFound:
    with pytest.raises(BoardNotFound) as caught:
        detect(image, board)
    assert caught.value.reason in BoardNotFound.REASONS
    assert str(caught.value).endswith(".")
    return caught.value


@settings(max_examples=20)
@given(
    tilt=st.floats(0, 50),
    about=st.floats(0, 360),
    roll=st.floats(-180, 180),
    span=st.floats(0.25, 0.5),
    asymmetric=st.booleans(),
    radius_share=st.floats(0.22, 0.38),
)
def test_circles_are_found_in_the_order_of_the_board_however_it_is_turned(
    tilt: float, about: float, roll: float, span: float, asymmetric: bool, radius_share: float
) -> None:
    board = ASYMMETRIC if asymmetric else SYMMETRIC
    image, true = picture(pose(board, tilt, about, roll, span), board, radius_share)
    view = detect(image, board, source="camera", stamp_ns=7)
    if not asymmetric and true[-1].sum() < true[0].sum():
        true = true[::-1]  # it looks the same, and the first circle is the one nearest to the top left
    assert rms(view.image_points, true) < 0.05
    np.testing.assert_array_equal(view.object_points, board.points)
    assert (view.source, view.stamp_ns) == ("camera", 7)


@pytest.mark.parametrize("roll", [10, 100, 190, 280])
@pytest.mark.parametrize(
    ("board", "turns"),
    [
        (CircleGrid(5, 5, 0.03), 4),
        (CircleGrid(3, 7, 0.03), 2),
        (AsymmetricCircleGrid(3, 4, 0.03), 2),
        (AsymmetricCircleGrid(3, 6, 0.03), 2),
        (AsymmetricCircleGrid(4, 5, 0.03), 1),
    ],
    ids=str,
)
def test_every_kind_of_symmetry_has_one_order(
    board: CircleGrid | AsymmetricCircleGrid, turns: int, roll: float
) -> None:
    assert board.turns == turns
    image, true = picture(pose(board, 20, 30, roll), board)
    found = detect(image, board).image_points
    dense = np.full((*board.pattern.shape, 2), np.nan)
    dense[board.pattern] = true
    orders = [np.rot90(dense, k)[board.pattern] for k in range(0, 4, 4 // turns)]
    assert np.isfinite(orders).all()
    assert rms(found, min(orders, key=lambda order: order[0].sum())) < 0.05


@KINDS
@pytest.mark.parametrize("camera", [CAMERA, BARREL], ids=["pinhole", "barrel"])
@pytest.mark.parametrize("radius_share", [0.25, 0.4])
@pytest.mark.parametrize("tilt", [0, 30, 60])
def test_neither_perspective_nor_the_lens_biases_the_centres(
    board: CircleGrid | AsymmetricCircleGrid, camera: Any, radius_share: float, tilt: float
) -> None:
    along = []
    for about in (30, 210):
        T = pose(board, tilt, about, span=0.4, camera=camera)
        image, true = picture(T, board, radius_share, camera)
        found = detect(image, board).image_points
        error = found - either_way(found, true)
        assert np.abs(error).max() < 0.15
        assert np.sqrt(np.mean(error**2)) < 0.025
        away = np.radians(about + 90)  # perspective shifts the ellipses along the tilt
        along.append(error @ [np.cos(away), np.sin(away)])
    assert abs(np.mean(along)) < 0.006


@KINDS
def test_centres_are_better_than_those_of_opencv(board: CircleGrid | AsymmetricCircleGrid) -> None:
    flag = cv2.CALIB_CB_SYMMETRIC_GRID if board is SYMMETRIC else cv2.CALIB_CB_ASYMMETRIC_GRID
    image, true = picture(pose(board, 25), board, read_noise=2.0)
    ok, theirs = cv2.findCirclesGrid(image, (board.columns, board.rows), flags=flag)
    assert ok
    theirs, ours = theirs.reshape(-1, 2), detect(image, board).image_points
    assert rms(ours, either_way(ours, true)) < 0.4 * rms(theirs, either_way(theirs, true))


@KINDS
@pytest.mark.parametrize(("noise", "blur"), [(2.0, 0.7), (6.0, 1.0), (4.0, 2.0)])
def test_sigma_is_the_size_of_the_error(
    board: CircleGrid | AsymmetricCircleGrid, noise: float, blur: float
) -> None:
    z = []
    for seed in range(3):
        image, true = picture(pose(board, 25, 70 * seed), board, seed=seed, read_noise=noise, blur_px=blur)
        view = detect(image, board)
        assert view.sigma is not None
        z.append((view.image_points - either_way(view.image_points, true)) / view.sigma[:, None])
    assert 0.75 < np.sqrt(np.mean(np.square(z))) < 1.3


def test_edge_width_and_spacing_are_measured() -> None:
    detection = detect_board(picture(pose(SYMMETRIC, 0), blur_px=1.5)[0], SYMMETRIC)
    assert detection.edge_width_px == pytest.approx(2.563 * np.hypot(1.5, 12**-0.5), rel=0.06)
    spacing = 0.5 * np.hypot(*SIZE) / np.hypot(9, 6)
    assert detection.square_px == pytest.approx(spacing, rel=0.05)


@pytest.mark.parametrize("kind", ["bgr", "uint16", "12 bit"])
def test_any_grey_or_colour_image_serves(kind: str) -> None:
    image, true = picture(pose(SYMMETRIC, 20))
    deep = image.astype(np.uint16)
    given_image = {"bgr": np.dstack([image] * 3), "uint16": deep * 257, "12 bit": deep * 16}[kind]
    found = detect(given_image, SYMMETRIC).image_points
    assert rms(found, either_way(found, true)) < 0.03


@KINDS
def test_clutter_and_marks_beside_the_board_are_no_part_of_it(
    board: CircleGrid | AsymmetricCircleGrid,
) -> None:
    background = clutter(SIZE, np.random.default_rng(4))
    image, true = picture(pose(board, 30), board, background=background)
    cv2.circle(image, np.rint(2 * true[0] - true[1]).astype(int).tolist(), 6, 20, -1)
    found = detect(image, board).image_points
    assert rms(found, either_way(found, true)) < 0.05


@KINDS
def test_a_board_of_another_size_is_told(board: CircleGrid | AsymmetricCircleGrid) -> None:
    image, _ = picture(pose(board, 20), board)
    error = refusal(image, type(board)(board.columns - 1, board.rows - 2, 0.02))
    assert error.reason == "wrong size"
    assert f"Found a grid of {len(board.points)} circles" in str(error)


def test_an_asymmetric_grid_in_a_mirror_is_refused_where_it_shows() -> None:
    board = AsymmetricCircleGrid(3, 8, 0.02)
    image, _ = picture(pose(board, 20), board)
    assert len(detect(image, board)) == 24
    assert refusal(image[:, ::-1], board).reason == "wrong size"


def test_a_symmetric_grid_looks_the_same_in_a_mirror() -> None:
    image, true = picture(pose(SYMMETRIC, 20))
    found = detect(image[:, ::-1], SYMMETRIC).image_points
    mirrored = np.column_stack([SIZE[0] - 1 - true[:, 0], true[:, 1]]).reshape(7, 10, 2)[:, ::-1]
    assert rms(found, either_way(found, mirrored.reshape(-1, 2))) < 0.03


@KINDS
@pytest.mark.parametrize("other", [SYMMETRIC, ASYMMETRIC, CircleGrid(5, 4, 0.02)], ids=str)
def test_of_two_boards_the_one_asked_for_is_found(
    board: CircleGrid | AsymmetricCircleGrid, other: CircleGrid | AsymmetricCircleGrid
) -> None:
    left, right = pose(board, 20, 30, 10, 0.28, (-160, 60)), pose(other, 20, 60, 30, 0.28, (160, -60))
    behind, true = picture(left, board)
    image, others = picture(right, other, background=behind / 255)
    for asked in (board, other):
        found = detect(image, asked).image_points
        shown = [each for each, of in ((true, board), (others, other)) if of == asked]
        assert min(rms(found, either_way(found, each)) for each in shown) < 0.05


@KINDS
@pytest.mark.parametrize("radius_px", [2, 4, 6])
def test_a_circle_covered_in_part_is_refused_or_said_to_be_uncertain(
    board: CircleGrid | AsymmetricCircleGrid, radius_px: int
) -> None:
    image, true = picture(pose(board, 30), board)
    for index in range(0, len(true), 5):
        spot = tuple(np.rint(true[index] + [6, 3]).astype(int).tolist())
        try:
            view = detect(cv2.circle(image.copy(), spot, radius_px, 255, -1, cv2.LINE_AA), board)
        except BoardNotFound as error:
            assert error.reason in ("cut off", "not planar")  # noqa: PT017
        else:
            error = np.abs(view.image_points - either_way(view.image_points, true)).max(axis=1)
            assert (error < 4 * view.sigma + 0.05).all()


@KINDS
@pytest.mark.parametrize("strength", [100, 200, 400])
def test_glare_gives_right_centres_or_none(board: CircleGrid | AsymmetricCircleGrid, strength: float) -> None:
    image, true = picture(pose(board, 20), board)
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    for u, v in true[[0, 12, 31]]:
        lamp = strength * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 50**2))
        try:
            found = detect(np.clip(image + lamp, 0, 255).astype(np.uint8), board).image_points
        except BoardNotFound as error:
            assert error.reason == "cut off"  # noqa: PT017
        else:
            assert np.abs(found - either_way(found, true)).max() < 0.6


@KINDS
def test_motion_during_the_readout_shears_a_board_and_vibration_is_refused(
    board: CircleGrid | AsymmetricCircleGrid,
) -> None:
    image, true = picture(pose(board, 30), board)
    x, y = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in SIZE))

    def shaken(offset: Any) -> Any:
        return cv2.remap(image, (x - offset).astype(np.float32), y, cv2.INTER_CUBIC)

    panned = detect(shaken(40 * y / SIZE[1]), board).image_points
    sheared = true + np.column_stack([40 * true[:, 1] / SIZE[1], np.zeros(len(true))])
    assert rms(panned, either_way(panned, sheared)) < 0.05
    error = refusal(shaken(4 * np.sin(8 * np.pi * y / SIZE[1])), board)
    assert "flat" in str(error) or "circles cannot be seen" in str(error)


def test_a_smear_that_touches_the_next_circle_says_so() -> None:
    image, true = picture(pose(SYMMETRIC, 20), motion_px=21)
    view = detect(image, SYMMETRIC)
    error = np.linalg.norm(view.image_points - either_way(view.image_points, true), axis=1)
    assert error.max() > 1.5
    assert (error < 3 * view.sigma).all()


@KINDS
@pytest.mark.parametrize("image", [np.full((50, 50), np.nan), np.zeros((0, 9), np.uint8), None], ids=str)
def test_what_is_no_image_is_refused(board: CircleGrid | AsymmetricCircleGrid, image: Any) -> None:
    with pytest.raises(InvalidInput, match=r"An image must .*\.$"):
        detect(image, board)


@pytest.mark.parametrize("shift", [(230.0, 0.0), (300.0, 0.0), (0.0, 190.0)])
def test_a_board_beyond_the_border_is_cut_off(shift: tuple[float, float]) -> None:
    image, _ = picture(pose(SYMMETRIC, 20, shift_px=shift))
    assert refusal(image).reason == "cut off"


@KINDS
@pytest.mark.parametrize("which", [0, 4, 22])
def test_covered_circles_are_not_invented(board: CircleGrid | AsymmetricCircleGrid, which: int) -> None:
    image, true = picture(pose(board, 20), board)
    error = refusal(cv2.circle(image, np.rint(true[which]).astype(int).tolist(), 15, 255, -1), board)
    assert error.reason in ("cut off", "wrong size")


@pytest.mark.parametrize("conditions", [{"blur_px": 9.0}, {"motion_px": 22.0}], ids=str)
def test_a_blurred_board_is_refused(conditions: dict[str, float]) -> None:
    image, _ = picture(pose(SYMMETRIC, 20), **conditions)
    # Circles smeared over one another are no longer told from covered ones.
    assert refusal(image).reason in ("blurred", "no board", "cut off")


def test_circles_of_no_plane_are_refused() -> None:
    image, true = picture(pose(SYMMETRIC, 10))
    y, x = np.mgrid[: SIZE[1], : SIZE[0]].astype(np.float32)
    bump = 6 * np.exp(-((x - true[33, 0]) ** 2 + (y - true[33, 1]) ** 2) / 2 / 18**2)
    error = refusal(cv2.remap(image, (x - bump).astype(np.float32), y, cv2.INTER_CUBIC))
    assert error.reason == "not planar"


@KINDS
@pytest.mark.parametrize("name", NO_BOARD)
def test_where_no_board_is_none_is_found(board: CircleGrid | AsymmetricCircleGrid, name: str) -> None:
    assert refusal(no_board(name), board).reason == "no board"


@KINDS
def test_a_chessboard_is_none(board: CircleGrid | AsymmetricCircleGrid) -> None:
    image, _ = chessboard_picture(chessboard_pose(BOARD, 40, 20, 30))
    assert refusal(image, board).reason == "no board"


def test_small_circles_of_a_large_image_are_found() -> None:
    large = np.full((1200, 1600), 90, np.uint8)
    image, true = picture(pose(SYMMETRIC, 20, span=0.22))
    large[300:780, 700:1340] = image
    found = detect(large, SYMMETRIC).image_points
    assert rms(found, either_way(found, true + np.array([700, 300]))) < 0.05


@pytest.mark.skipif(not REAL, reason="FEWCAL_REAL_DATA is not set")
def test_real_boards_are_found_and_explained_better_than_with_the_centres_of_opencv() -> None:
    folder = Path(str(REAL)) / "sets" / "visp_circles"
    meta = json.loads((folder / "meta.json").read_text())
    board = CircleGrid(meta["board"]["cols"], meta["board"]["rows"], meta["board"]["spacing_m"])
    reference = np.load(folder / "corners.npz")
    ours, theirs = [], []
    for view, name in enumerate(reference["names"].astype(str)):
        ours.append(detect(cv2.imread(str(folder / "images" / name)), board))
        found = ours[-1].image_points
        grid = reference["img"][slice(*reference["view_ptr"][view : view + 2])].reshape(6, 6, 2)
        turns = [np.rot90(grid, k).reshape(-1, 2) for k in range(4)]
        theirs.append(View(board.points, min(turns, key=lambda turn: rms(found, turn))))
        assert rms(found, theirs[-1].image_points) < 0.2
        assert found[0].sum() < found[[5, 30, 35]].sum(axis=1).min()
        assert np.linalg.det([found[1] - found[0], found[6] - found[0]]) > 0
    assert len(ours) == 5
    size = tuple(meta["image_size"])
    assert calibrate(ours, size).rms < calibrate(theirs, size).rms
