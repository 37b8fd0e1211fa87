from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fewcal.boards import Chessboard
from fewcal.camera import Camera, project_pixel_model
from fewcal.errors import InvalidInput, ModelFoldsOver
from fewcal.virtual_camera import (
    FIGURE_12_CAMERA,
    FIGURE_12_REACH,
    PAPER_CAMERA,
    PAPER_COLUMNS,
    PAPER_REACH,
    PAPER_TILTS_DEG,
    VirtualCamera,
    board_pose,
    exact_view,
    fill_image,
    paper_trial,
    paper_trials,
)

SKEWED = VirtualCamera(900.0, 950.0, 310.0, 250.0, np.array([1e-7, -1e-13, 2e-6, -3e-6]), (640, 480), s=4.0)
EVERYDAY = Camera(1037.2, 1038.9, 652.3, 471.8, np.array([-0.21, 0.08, 4e-4, -6e-4, 0.0]))
SAMPLE = [(4, 1.2), (30, 1.2), (6, 30.0), (15, 45.6), (4, 60.0), (30, 60.0)]


def tilt_deg(T):
    return np.degrees(np.arccos(T[2, 2]))


class TestVirtualCamera:
    @pytest.mark.parametrize("camera", [PAPER_CAMERA, FIGURE_12_CAMERA, SKEWED])
    def test_projects_by_the_papers_equations(self, camera):
        X = np.random.default_rng(0).uniform([-0.1, -0.1, 0.9], [0.1, 0.1, 1.5], (50, 3))
        expected = project_pixel_model(X, camera.intrinsics, camera.pixel_distortion)
        np.testing.assert_allclose(camera.project(X), expected, rtol=0, atol=1e-9)

    @pytest.mark.parametrize("camera", [PAPER_CAMERA, SKEWED])
    def test_unproject_inverts_project(self, camera):
        pixels = np.random.default_rng(1).uniform(0, camera.image_size, (4, 50, 2))
        rays = camera.unproject(pixels)
        np.testing.assert_allclose(camera.project(rays), pixels, rtol=0, atol=1e-8)
        np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1)

    def test_a_pose_moves_points_first(self):
        T = board_pose(30, 20, distance=2.0)
        points = Chessboard(5, 4, 0.03).points
        moved = points @ T[:3, :3].T + T[:3, 3]
        np.testing.assert_array_equal(PAPER_CAMERA.project(points, T), PAPER_CAMERA.project(moved))

    def test_what_is_behind_has_no_pixel(self):
        assert np.isnan(PAPER_CAMERA.project([0.0, 0.0, -1.0])).all()

    def test_says_where_it_folds_over(self):
        radius = FIGURE_12_CAMERA.fold_radius_px
        pixels = [[1000 + radius - 1, 1000], [1000 + radius + 1, 1000]]
        rays = FIGURE_12_CAMERA.unproject(pixels, folded="nan")
        assert np.isnan(rays).any(axis=1).tolist() == [False, True]
        with pytest.raises(ModelFoldsOver, match="folded over"):
            FIGURE_12_CAMERA.unproject(pixels)

    def test_refuses_what_is_no_camera(self):
        with pytest.raises(InvalidInput, match="four of k1"):
            VirtualCamera(1, 1, 0, 0, np.zeros(5))
        with pytest.raises(InvalidInput, match="finite"):
            VirtualCamera(np.nan, 1, 0, 0)


class TestBoardPose:
    @given(st.floats(0, 89), st.floats(0, 360), st.floats(0, 360), st.floats(0.1, 10))
    def test_has_the_tilt_and_the_axis_asked_for(self, tilt, axis, roll, distance):
        centre = np.array([0.1, 0.06])
        T = board_pose(tilt, axis, roll, distance, centre)
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(T[2, 2], np.cos(np.radians(tilt)), atol=1e-12)
        about = np.array([np.cos(np.radians(axis)), np.sin(np.radians(axis))])
        np.testing.assert_allclose(about @ T[:2, 2], 0, atol=1e-12)  # the normal leaves the axis alone
        np.testing.assert_allclose(T @ [*centre, 0, 1], [0, 0, distance, 1], atol=1e-12)


class TestFillImage:
    @pytest.mark.parametrize(
        ("camera", "size"), [(EVERYDAY, (1280, 960)), (SKEWED, (640, 480)), (PAPER_CAMERA, (1200, 1200))]
    )
    @pytest.mark.parametrize("tilt", [0.0, 25.0, 60.0])
    def test_the_board_just_fits_the_frame(self, camera, size, tilt):
        board = Chessboard(9, 6, 0.025)
        rotation = board_pose(tilt, 70, 10)[:3, :3]
        T = fill_image(camera, size, board.points, rotation, reach=0.9)
        half = (np.array(size) - 1) / 2
        pixels = camera.project(board.points, T)
        offset = (pixels - half) / half
        np.testing.assert_array_equal(T[:3, :3], rotation)
        np.testing.assert_allclose(np.abs(offset).max(), 0.9, atol=1e-6)
        np.testing.assert_allclose((offset.min(axis=0) + offset.max(axis=0)) / 2, 0, atol=1e-3)

    def test_refuses_a_region_in_which_the_model_folds_over(self):
        points, rotation = Chessboard(8, 6, 0.03).points, board_pose(20, 30)[:3, :3]
        share = FIGURE_12_CAMERA.fold_radius_px / 1000
        fill_image(FIGURE_12_CAMERA, (2000, 2000), points, rotation, 0.97 * share, "circle")
        with pytest.raises(InvalidInput, match="folds over"):
            fill_image(FIGURE_12_CAMERA, (2000, 2000), points, rotation, 1.05 * share, "circle")

    def test_names_its_outlines(self):
        with pytest.raises(InvalidInput, match="outline"):
            fill_image(EVERYDAY, (1280, 960), Chessboard(4, 4, 0.03).points, np.eye(3), outline="hexagon")


class TestPaperTrials:
    def test_are_as_many_as_the_papers(self):
        assert len(PAPER_COLUMNS) * len(PAPER_TILTS_DEG) == 1350
        assert (PAPER_COLUMNS[0], PAPER_COLUMNS[-1]) == (4, 30)
        np.testing.assert_allclose(PAPER_TILTS_DEG, np.linspace(1.2, 60, 50))
        first = [trial for trial, _ in zip(paper_trials(), range(51), strict=False)]
        assert [(t.columns, t.tilt_deg) for t in first] == [*((4, t) for t in PAPER_TILTS_DEG), (5, 1.2)]

    @pytest.mark.parametrize(("columns", "tilt"), SAMPLE)
    def test_show_the_whole_board_displaced_as_the_paper_says(self, columns, tilt):
        trial = paper_trial(columns, tilt)
        (view,), (T,) = trial.views, trial.poses
        assert len(view) == 6 * columns
        assert tilt_deg(T) == pytest.approx(tilt, abs=1e-9)
        assert (view.image_points > 0).all()
        assert (view.image_points < 1199).all()
        seen = view.object_points @ T[:3, :3].T + T[:3, 3]
        undistorted = seen[:, :2] / seen[:, 2:] * [4000, 4010] + 600
        displacement = np.linalg.norm(view.image_points - undistorted, axis=1).max()
        # The principal point lies half a pixel beside the middle of the image: 0.15 px at this radius.
        assert displacement == pytest.approx(35.67, abs=0.2)

    @pytest.mark.parametrize(("columns", "tilt"), SAMPLE)
    def test_of_two_views_are_two_planes(self, columns, tilt):
        trial = paper_trial(columns, tilt, views=2)
        assert [round(tilt_deg(T), 6) for T in trial.poses] == [1.2, tilt]
        assert np.array_equal(trial.poses[1], paper_trial(columns, tilt).poses[0])
        cosine = trial.poses[0][:3, 2] @ trial.poses[1][:3, 2]
        assert np.degrees(np.arccos(cosine)) > 1.6

    def test_are_the_same_each_time_unless_drawn(self):
        assert np.array_equal(paper_trial(9, 24.0).poses, paper_trial(9, 24.0).poses)
        drawn = [paper_trial(9, 24.0, 2, rng=np.random.default_rng(seed)).poses for seed in (0, 0, 1)]
        assert np.array_equal(drawn[0], drawn[1])
        assert not np.allclose(drawn[0], drawn[2])
        assert [round(tilt_deg(T), 6) for T in drawn[2]] == [1.2, 24.0]

    def test_have_a_camera_for_figure_12(self):
        trial = paper_trial(12, 30.0, 2, FIGURE_12_CAMERA, FIGURE_12_REACH)
        for view, T in zip(trial.views, trial.poses, strict=True):
            assert np.linalg.norm(view.image_points - 999.5, axis=1).max() < FIGURE_12_CAMERA.fold_radius_px
            np.testing.assert_array_equal(
                view.image_points, exact_view(FIGURE_12_CAMERA, view.object_points, T).image_points
            )

    def test_reach_is_where_the_displacement_is_the_papers(self):
        radius = PAPER_REACH * 599.5
        ray = PAPER_CAMERA.unproject([600 + radius, 600])
        assert radius - 4000 * ray[0] / ray[2] == pytest.approx(35.67, abs=0.05)

    def test_have_one_view_or_two(self):
        with pytest.raises(InvalidInput, match="one view or two"):
            paper_trial(9, 24.0, views=3)
