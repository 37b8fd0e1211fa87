from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from fewcal.boards import Chessboard
from fewcal.camera import Camera
from fewcal.corner_refinement import refine_corners
from fewcal.errors import InvalidInput
from fewcal.rendering import BLACK, IDEAL, MARGIN, PLAIN_BACKGROUND, WHITE, Conditions, clutter, render
from fewcal.virtual_camera import PAPER_CAMERA, board_pose, fill_image, paper_pose

SIZE = (1280, 960)
CAMERA = Camera(1037.2, 1038.9, 652.3, 471.8, np.array([-0.21, 0.08, 4e-4, -6e-4, 0.0]))
BOARD = Chessboard(9, 6, 0.025)
SMALL = Camera(60.0, 60.5, 31.0, 24.6, np.array([-0.2, 0.05, 2e-3, -1e-3, 0.0]))
SMALL_SIZE = (64, 48)


def filling(tilt=0.0, axis=0.0, roll=0.0, camera=CAMERA, size=SIZE, board=BOARD, reach=0.8):
    return fill_image(camera, size, board.points, board_pose(tilt, axis, roll)[:3, :3], reach)


def level(reflectance):
    return 255 * IDEAL.exposure * reflectance


def by_brute_force(camera, size, board, T, across):
    """Grey levels of a perfect camera, each pixel the mean of across x across rays cast on their own."""
    fine = (np.arange(across) + 0.5) / across - 0.5
    u = (np.arange(size[0])[:, None] + fine).ravel()
    v = (np.arange(size[1])[:, None] + fine).ravel()
    rays = camera.unproject(np.stack(np.meshgrid(u, v), axis=-1))
    plane = T[:3, [0, 1, 3]] @ np.diag([board.square_size, board.square_size, 1])
    hit = rays @ np.linalg.inv(plane).T
    x, y = hit[..., 0] / hit[..., 2], hit[..., 1] / hit[..., 2]
    left, top, right, bottom = np.array(board.draw().extent) / board.square_size
    rim = MARGIN * min(right - left, bottom - top)
    shown = np.full(x.shape, PLAIN_BACKGROUND)
    shown[(x > left - rim) & (x < right + rim) & (y > top - rim) & (y < bottom + rim)] = WHITE
    x, y = np.floor(x), np.floor(y)
    inside = (x >= -1) & (x < board.columns) & (y >= -1) & (y < board.rows)
    shown[inside & ((x + y) % 2 == 0)] = BLACK
    return level(shown).reshape(size[1], across, size[0], across).mean(axis=(1, 3))


class TestTruth:
    @pytest.mark.parametrize(("tilt", "axis", "roll"), [(0, 0, 0), (0, 0, 7), (40, 35, 20)])
    def test_a_pixel_is_the_mean_over_its_area_through_the_distortion(self, tilt, axis, roll):
        board = Chessboard(5, 4, 0.03)
        T = filling(tilt, axis, roll, SMALL, SMALL_SIZE, board, reach=0.7)
        expected = by_brute_force(SMALL, SMALL_SIZE, board, T, across=16)
        error = render(SMALL, SMALL_SIZE, board, T, IDEAL).astype(float) - expected
        # 0.5 of rounding, and what the two ways of sampling leave open; a point-sampled image is 100 off.
        assert np.abs(error).max() < 12
        assert np.sqrt(np.mean(error**2)) < 1.2
        # An edge that lies 0.01 px off shows as 0.01 of the step in the pixels along it.
        edges = np.abs(cv2.Laplacian(expected, cv2.CV_64F)) > 20
        assert abs(error[edges].mean()) < 0.01 * level(WHITE - BLACK)

    @pytest.mark.parametrize(
        ("tilt", "axis", "roll"), [(0, 0, 0), (35, 0, 5), (35, 90, -12), (45, 40, 3), (30, 130, 80)]
    )
    def test_corners_are_where_the_camera_projects_them(self, tilt, axis, roll):
        T = filling(tilt, axis, roll)
        truth = CAMERA.project(BOARD.points, T)
        image = render(CAMERA, SIZE, BOARD, T, replace(IDEAL, blur_px=1.0))
        found = refine_corners(image, truth.reshape(6, 9, 2)).points.reshape(-1, 2)
        error = found - truth
        assert np.abs(error.mean(axis=0)).max() < 0.005
        assert np.sqrt(np.mean(error**2)) < 0.01

    def test_an_independent_corner_finder_agrees(self):
        T = filling(35, 60, 10)
        truth = CAMERA.project(BOARD.points, T)
        image = render(CAMERA, SIZE, BOARD, T, replace(IDEAL, blur_px=1.5))
        start = truth.astype(np.float32).reshape(-1, 1, 2) + 0.3
        found = cv2.cornerSubPix(image, start, (7, 7), (-1, -1), (3, 100, 1e-5)).reshape(-1, 2)
        assert np.abs((found - truth).mean(axis=0)).max() < 0.01
        assert np.sqrt(np.mean((found - truth) ** 2)) < 0.03  # its own error at this blur

    def test_the_papers_camera_takes_pictures_too(self):
        board, T = Chessboard(9, 6, 0.03), paper_pose(9, 30.0, 50.0)
        truth = PAPER_CAMERA.project(board.points, T)
        image = render(PAPER_CAMERA, (1200, 1200), board, T, replace(IDEAL, blur_px=1.0))
        found = refine_corners(image, truth.reshape(6, 9, 2)).points.reshape(-1, 2)
        assert np.sqrt(np.mean((found - truth) ** 2)) < 0.01

    def test_the_square_beyond_the_first_corner_is_black(self):
        T = filling(20, 30, 15, reach=0.6)
        image = render(CAMERA, SIZE, BOARD, T, IDEAL)
        centres = (
            np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-1.5, -1.5, 0]]) * BOARD.square_size
        )
        u, v = np.round(CAMERA.project(centres, T)).astype(int).T
        np.testing.assert_allclose(image[v, u], level(np.array([BLACK, WHITE, BLACK, WHITE])), atol=0.51)

    def test_rays_beyond_a_fold_see_the_background(self):
        folding = Camera(300.0, 300.0, 319.5, 239.5, np.array([-0.45, 0.0, 0.0, 0.0, 0.0]))
        assert folding.fold_radius_px < 399  # inside the corners of the image
        T = board_pose(10, 40, distance=0.05, centre=(0.1, 0.06))
        image = render(folding, (640, 480), BOARD, T, IDEAL)
        np.testing.assert_allclose(image[[0, 0, -1, -1], [0, -1, 0, -1]], level(PLAIN_BACKGROUND), atol=0.51)


class TestConditions:
    def test_noise_is_as_strong_as_it_says(self):
        conditions = replace(IDEAL, read_noise=2.0, full_well=5000.0)
        image = render(CAMERA, SIZE, None, None, conditions, rng=np.random.default_rng(1)).astype(float)
        signal = level(PLAIN_BACKGROUND)
        assert image.mean() == pytest.approx(signal, abs=0.05)
        assert image.var() == pytest.approx(4 + signal * 255 / 5000 + 1 / 12, rel=0.02)

    def test_vignetting_and_the_light_from_a_side(self):
        flat = np.ones(SIZE[::-1])
        dark = render(CAMERA, SIZE, None, None, replace(IDEAL, vignetting=0.4), background=flat)
        assert dark[0, 0] / dark[480, 640] == pytest.approx(0.6, abs=0.01)
        lit = render(CAMERA, SIZE, None, None, replace(IDEAL, light_slope=0.5, light_deg=0), background=flat)
        assert lit[480, -1] > 1.3 * lit[480, 0]  # it comes from where u grows
        assert lit[0, 640] == lit[-1, 640]

    def test_motion_blurs_along_its_direction_and_moves_nothing(self):
        T = filling()
        still = render(CAMERA, SIZE, BOARD, T, IDEAL).astype(float)
        moved = render(CAMERA, SIZE, BOARD, T, replace(IDEAL, motion_px=9, motion_deg=0)).astype(float)
        across, along = np.abs(np.diff(moved, axis=1)).max(), np.abs(np.diff(moved, axis=0)).max()
        assert across < 0.2 * np.abs(np.diff(still, axis=1)).max()
        assert along > 0.9 * np.abs(np.diff(still, axis=0)).max()
        truth = CAMERA.project(BOARD.points, T)
        found = refine_corners(
            render(CAMERA, SIZE, BOARD, T, replace(IDEAL, motion_px=4, motion_deg=30)), truth.reshape(6, 9, 2)
        )
        assert np.abs((found.points.reshape(-1, 2) - truth).mean(axis=0)).max() < 0.01

    def test_a_board_that_moves_during_the_exposure_blurs_alone(self):
        background = clutter(SIZE, np.random.default_rng(0))
        poses = np.repeat(filling(reach=0.4)[None], 3, axis=0)
        poses[:, 0, 3] += np.array([-4, 0, 4]) * poses[0, 2, 3] / CAMERA.fx
        images = [render(CAMERA, SIZE, BOARD, T, IDEAL, background=background) for T in poses]
        image = render(CAMERA, SIZE, BOARD, poses, IDEAL, background=background)
        assert np.abs(image - np.mean(images, axis=0)).max() <= 1
        assert np.array_equal(image[:100], images[0][:100])
        assert np.abs(images[0].astype(int) - image).max() > 50

    def test_bits_are_as_many_as_it_says(self):
        image = render(CAMERA, SIZE, BOARD, filling(), Conditions(bit_depth=5))
        assert image.dtype == np.uint8
        assert not (image % 8).any()
        assert len(np.unique(image)) > 16

    def test_the_same_call_gives_the_same_image(self):
        first, again, other = (
            render(SMALL, SMALL_SIZE, None, None, rng=np.random.default_rng(seed)) for seed in (3, 3, 4)
        )
        assert np.array_equal(first, again)
        assert not np.array_equal(first, other)

    @pytest.mark.parametrize(
        "bad",
        [{"blur_px": -1}, {"exposure": np.nan}, {"bit_depth": 9}, {"full_well": 0}, {"read_noise": np.inf}],
    )
    def test_impossible_ones_are_refused(self, bad):
        with pytest.raises(InvalidInput, match=next(iter(bad))):
            Conditions(**bad)


class TestRender:
    def test_clutter_is_a_background(self):
        background = clutter(SIZE, np.random.default_rng(5))
        assert background.shape == SIZE[::-1]
        assert 0 <= background.min() < background.max() <= 1
        assert np.array_equal(background, clutter(SIZE, np.random.default_rng(5)))
        image = render(CAMERA, SIZE, None, None, IDEAL, background=background)
        np.testing.assert_allclose(image, level(background), atol=0.51)

    def test_a_board_out_of_sight_leaves_the_scene_alone(self):
        T = filling()
        T[0, 3] += 10
        assert np.array_equal(render(CAMERA, SIZE, BOARD, T, IDEAL), render(CAMERA, SIZE, None, None, IDEAL))

    def test_a_board_across_the_border_is_cut_off(self):
        T = filling()
        T[0, 3] += T[2, 3] * 0.6
        image = render(CAMERA, SIZE, BOARD, T, IDEAL)
        assert image[:, :200].std() == 0
        assert image[:, -50:].std() > 50

    def test_a_board_from_behind_is_refused(self):
        T = filling()
        T[:3, :3] = T[:3, :3] @ np.diag([1, -1, -1])
        with pytest.raises(InvalidInput, match="back or edge"):
            render(CAMERA, SIZE, BOARD, T)

    def test_a_wrong_background_or_size_is_refused(self):
        with pytest.raises(InvalidInput, match=r"\(960, 1280\)"):
            render(CAMERA, SIZE, None, None, background=np.zeros(SIZE))
        with pytest.raises(InvalidInput, match="width and height"):
            render(CAMERA, (0, 10), None, None)
        with pytest.raises(InvalidInput, match="shape"):
            render(CAMERA, SIZE, BOARD, np.eye(3))
