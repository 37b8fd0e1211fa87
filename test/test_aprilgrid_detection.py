from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from board_pictures import CAMERA, SIZE
from marker_pictures import (
    CHARUCO,
    REAL,
    errors,
    indices,
    marker_picture,
    needs_markers,
    real_views,
)

from fewcal.aprilgrid import AprilGrid
from fewcal.boards import parse_board
from fewcal.camera import Camera
from fewcal.errors import BoardNotFound
from fewcal.rendering import Conditions, render
from fewcal.session import Session

pytestmark = needs_markers
GRID = AprilGrid(4, 3, 0.088, 0.3, "tag36h11")
TAG_PX = 60.0


def pose(
    board: AprilGrid,
    tag_px: float,
    tilt_deg: float = 0,
    about_deg: float = 0,
    roll_deg: float = 0,
    shift_px: tuple[float, float] = (0, 0),
) -> Any:
    about = np.radians(about_deg)
    tilt, _ = cv2.Rodrigues(np.radians(tilt_deg) * np.array([np.cos(about), np.sin(about), 0.0]))
    roll, _ = cv2.Rodrigues(np.radians(roll_deg) * np.array([0.0, 0.0, 1.0]))
    T = np.eye(4)
    T[:3, :3] = tilt @ roll
    T[:3, 3] = np.array([*np.divide(shift_px, CAMERA.fx), 1.0]) * CAMERA.fx * board.tag_size / tag_px
    T[:3, 3] -= T[:3, :3] @ board.points.mean(axis=0)
    return T


def picture(board: AprilGrid, *where: Any, camera: Camera = CAMERA, **conditions: float) -> Any:
    T = pose(board, *where)
    return render(camera, SIZE, board, T, Conditions(**conditions)), camera.project(board.points, T)


def refusal(image: Any, board: AprilGrid = GRID) -> BoardNotFound:
    with pytest.raises(BoardNotFound) as caught:
        board.detect(image)
    assert str(caught.value).endswith(".")
    return caught.value


@pytest.mark.parametrize("roll", [0, 100, 185, 275])
@pytest.mark.parametrize("tilt", [0, 30, 50])
def test_every_corner_is_found_in_the_order_of_the_board(tilt: float, roll: float) -> None:
    image, true = picture(GRID, TAG_PX, tilt, 40, roll)
    found = GRID.detect(image, source="camera", stamp_ns=7)
    np.testing.assert_array_equal(indices(GRID, found), np.arange(48))
    assert np.abs(errors(GRID, found, true)).max() < 0.06
    assert (found.view.source, found.view.stamp_ns) == ("camera", 7)
    assert found.edge_width_px == pytest.approx(2.563 * np.hypot(0.7, 12**-0.5), rel=0.2)


@pytest.mark.parametrize(
    "text",
    [
        "aprilgrid:4x3:0.05:0.3:tag36h10",
        "aprilgrid:3x3:0.05:0.25:tag25h9",
        "aprilgrid:3x2:0.05:0.5:tag16h5",
        "aprilgrid:2x1:0.05:0.3:tag36h11",
    ],
)
def test_every_family_serves(text: str) -> None:
    board: Any = parse_board(text)
    image, true = picture(board, TAG_PX, 25, 20, 10)
    found = board.detect(image)
    assert len(found.view) == len(board.points)
    assert np.abs(errors(board, found, true)).max() < 0.06


@pytest.mark.parametrize("tag_px", [24, 34])
def test_small_tags_are_found(tag_px: float) -> None:
    board = replace(GRID, columns=6, rows=6)
    image, true = picture(board, tag_px, 20, 40, 10)
    found = board.detect(image)
    assert len(found.view) > 0.9 * len(board.points)
    assert np.abs(errors(board, found, true)).max() < 0.1


@pytest.mark.parametrize("shift", [(230.0, 0.0), (-250.0, 60.0), (0.0, -180.0), (200.0, 150.0)])
def test_a_part_of_the_board_is_enough(shift: tuple[float, float]) -> None:
    image, true = picture(GRID, 90, 30, 60, 10, shift)
    found = GRID.detect(image)
    seen = np.all((true > 1.9) & (true < np.array(SIZE) - 2.9), axis=1)
    assert 6 <= len(found.view) < 48
    assert seen[indices(GRID, found)].all()
    assert len(found.view) >= 0.8 * seen.sum()
    assert np.abs(errors(GRID, found, true)).max() < 0.08


@pytest.mark.parametrize("across", [False, True])
def test_one_line_of_tags_is_enough(across: bool) -> None:
    board = replace(GRID, columns=6, rows=6)
    image, true = picture(board, 45, 0)
    margin = 6
    if across:  # the upper row, with so many pixels below it
        end = int(true.reshape(12, 12, 2)[10, 0, 1]) + 1 + margin
        image = np.ascontiguousarray(image[:end])
    else:
        begin = int(true.reshape(12, 12, 2)[0, 10, 0]) - margin
        image, true = np.ascontiguousarray(image[:, begin:]), true - [begin, 0]
    found = board.detect(image)
    assert len(found.view) == 24
    assert np.abs(errors(board, found, true)).max() < 0.1


@pytest.mark.parametrize("tag_px", [40, 80])
@pytest.mark.parametrize(("noise", "blur"), [(2.0, 0.7), (6.0, 1.0)])
def test_sigma_is_the_size_of_the_error(noise: float, blur: float, tag_px: float) -> None:
    z = []
    for about in range(0, 360, 120):
        image, true = picture(GRID, tag_px, 20, about, 10, read_noise=noise, blur_px=blur)
        found = GRID.detect(image)
        assert found.view.sigma is not None
        z.append(errors(GRID, found, true) / found.view.sigma[:, None])
    assert 0.7 < np.sqrt(np.mean(np.concatenate(z) ** 2)) < 1.4


class NarrowBorder(AprilGrid):
    drawn_border_bits = 1


@pytest.mark.parametrize(("tag_px", "largest"), [(34, 0.2), (90, 0.05)])
def test_tags_with_a_border_of_one_bit_are_found(tag_px: float, largest: float) -> None:
    image, true = picture(NarrowBorder(4, 3, 0.088, 0.3, "tag36h11"), tag_px, 20, 40, 10)
    found = GRID.detect(image)
    assert len(found.view) == 48
    assert np.abs(errors(GRID, found, true)).max() < largest


def test_tags_counted_from_the_top_are_found_and_told() -> None:
    board = replace(GRID, from_top=True)
    image, true = picture(board, TAG_PX, 20, 40, 15)
    found = board.detect(image)
    assert len(found.view) == 48
    assert np.abs(errors(board, found, true)).max() < 0.06
    assert "counted from the top row; add :top" in str(refusal(image))
    assert "counted from the bottom row; leave :top away" in str(refusal(picture(GRID, TAG_PX)[0], board))


def test_parts_of_a_board_make_a_camera() -> None:
    session = Session(GRID)
    places = [(90, 40, 10, 0, (190, 110)), (90, 40, 100, 0, (-190, -110))]
    assert all(session.add(picture(GRID, *place)[0]).kept for place in places)
    assert all(len(view) < 48 for view in session.views)
    calibration = session.calibrate()
    assert calibration.std is not None
    assert abs(calibration.camera.fx - CAMERA.fx) < min(3 * calibration.std["fx"], 0.01 * CAMERA.fx)


@pytest.mark.parametrize(
    ("asked", "sentence"),
    [
        ({"columns": 5}, "as on a board 4 tags wide, not 5;"),
        ({"columns": 3, "rows": 4}, "as on a board 4 tags wide, not 3;"),
        ({"rows": 2}, "Tags up to number 11 are seen"),
        ({"family": "tag25h9"}, "The tags are those of tag36h11, not of tag25h9;"),
    ],
)
def test_another_board_is_told(asked: dict[str, Any], sentence: str) -> None:
    image, _ = picture(GRID, TAG_PX, 20, 40, 15)
    error = refusal(image, replace(GRID, **asked))
    assert error.reason == "wrong size"
    assert sentence in str(error)


@pytest.mark.parametrize("gap", [0.15, 0.25, 0.28, 0.32, 0.4, 0.6])
@pytest.mark.parametrize("camera", [CAMERA, replace(CAMERA, distortion=[-0.35, 0.12, 0.0, 0.0, 0.0])])
def test_gaps_of_another_width_are_told_with_it(gap: float, camera: Camera) -> None:
    image, _ = picture(GRID, TAG_PX, 35, 40, 15, camera=camera, read_noise=4.0)
    error = refusal(image, replace(GRID, gap=gap))
    assert error.reason == "wrong size"
    assert f"The gaps between the tags are 0.30 of a tag, not {gap:g};" in str(error)


@pytest.mark.skipif(not REAL, reason="FEWCAL_REAL_DATA is not set")
def test_real_tags_are_found_in_order() -> None:
    board = parse_board("aprilgrid:5x4:0.02:0.25:tag36h10:top")
    for view, points, theirs in real_views("moms_april_left", board):
        here = np.stack([0.12 - points[:, 0], -points[:, 1], points[:, 2]], axis=1)
        assert len(view) >= max(len(theirs), 64)
        found = np.linalg.norm(view.object_points[:, None] - here, axis=2)
        assert found.min(axis=0).max() < 1e-6
        assert np.linalg.norm(view.image_points[found.argmin(axis=0)] - theirs, axis=1).max() < 1.0


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((480, 640), np.uint8),
        np.random.default_rng(3).integers(0, 256, (480, 640)).astype(np.uint8),
        np.zeros((1, 1), np.uint8),
        marker_picture(CHARUCO, 48, 20, 40, 15)[0] if hasattr(cv2, "aruco") else np.zeros((9, 9), np.uint8),
    ],
    ids=["black", "noise", "one pixel", "ChArUco"],
)
def test_where_no_board_is_none_is_found(image: Any) -> None:
    assert refusal(image).reason == "no board"


@pytest.mark.parametrize("family", ["tag36h11", "tag25h9", "tag16h5"])
def test_a_board_in_a_mirror_is_told(family: str) -> None:
    board = replace(GRID, family=family, from_top=family == "tag16h5")
    image, _ = picture(board, TAG_PX, 20, 40, 10)
    assert "in a mirror" in str(refusal(np.ascontiguousarray(image[:, ::-1]), board))
