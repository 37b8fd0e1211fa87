from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import pose

from fewcal.camera import Camera
from fewcal.closed_form import (
    checked_focal_length,
    nearest_rotation,
    poses_from_homographies,
    simplified_intrinsics,
    zhang_intrinsics,
)
from fewcal.errors import DegenerateViews, ImaginaryFocalLength

Array = NDArray[np.float64]

SQUARE = Camera(1234.0, 1234.0, 650.0, 460.0)
CENTRE = np.array([640.0, 480.0])
ARRANGEMENTS = [(40, 20), (35, 130), (50, 250), (25, 80)]


def homographies(A: Array, camera: Camera, count: int) -> tuple[Array, Array]:
    """Exact homographies (V, 3, 3) of a camera matrix, scaled at random, and the poses (V, 4, 4)."""
    T = np.stack([pose(*arrangement, camera=camera) for arrangement in ARRANGEMENTS[:count]])
    factors = np.array([3.0, -0.2, 40.0, -1.0])[:count, None, None]
    return A @ T[:, :3][:, :, [0, 1, 3]] * factors, T


# --- the simplified closed form ----------------------------------------------------------------------------


@pytest.mark.parametrize("count", [2, 3, 4])
def test_two_views_or_more_give_focal_length_and_principal_point(count: int) -> None:
    H, _ = homographies(SQUARE.matrix, SQUARE, count)
    np.testing.assert_allclose(simplified_intrinsics(H, CENTRE), [1234**2, 650, 460], rtol=1e-9)


def test_one_view_gives_the_focal_length_when_the_principal_point_is_given() -> None:
    H, _ = homographies(SQUARE.matrix, SQUARE, 1)
    np.testing.assert_allclose(simplified_intrinsics(H, np.array([650, 460])), [1234**2, 650, 460], rtol=1e-9)
    f2, u0, v0 = simplified_intrinsics(H, CENTRE)
    assert (u0, v0) == tuple(CENTRE)
    assert f2 != pytest.approx(1234**2, rel=1e-3)


@pytest.mark.parametrize("count", [2, 4])
def test_the_principal_point_can_be_held_for_more_views(count: int) -> None:
    H, _ = homographies(SQUARE.matrix, SQUARE, count)
    held = simplified_intrinsics(H, np.array([650, 460]), held=True)
    np.testing.assert_allclose(held, [1234**2, 650, 460], rtol=1e-9)
    assert tuple(simplified_intrinsics(H, CENTRE, held=True)[1:]) == tuple(CENTRE)


@given(f=st.floats(300, 8000), u0=st.floats(400, 900), v0=st.floats(300, 700), first=st.integers(0, 2))
def test_any_camera_with_square_pixels_follows_from_two_views(
    f: float, u0: float, v0: float, first: int
) -> None:
    camera = Camera(f, f, u0, v0)
    H, _ = homographies(camera.matrix, camera, 4)
    np.testing.assert_allclose(
        simplified_intrinsics(H[first : first + 2], CENTRE), [f * f, u0, v0], rtol=1e-6
    )


def test_batches_of_views() -> None:
    H, _ = homographies(SQUARE.matrix, SQUARE, 4)
    both = simplified_intrinsics(H.reshape(2, 2, 3, 3), CENTRE)
    np.testing.assert_allclose(both, np.tile([1234.0**2, 650, 460], (2, 1)), rtol=1e-9)
    each = simplified_intrinsics(H[:, None], np.array([650, 460]))
    np.testing.assert_allclose(each[:, 0], 1234**2, rtol=1e-9)


def test_a_fronto_parallel_view_has_no_focal_length() -> None:
    T = pose(0, camera=SQUARE)
    H = SQUARE.matrix @ T[:3, [0, 1, 3]]
    f2 = simplified_intrinsics(H[None], CENTRE)[0]
    assert not np.isfinite(f2) or f2 == 0
    with pytest.raises(ImaginaryFocalLength):
        checked_focal_length(f2)
    with np.errstate(all="raise"):
        assert not simplified_intrinsics(np.stack([np.eye(3)] * 2), CENTRE, held=True)[0] > 0


# --- Zhang's closed form -----------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [3, 4])
def test_zhang_gives_all_five_intrinsics_from_three_views(count: int) -> None:
    A = np.array([[1200.0, 7.0, 630.0], [0, 1250.0, 500.0], [0, 0, 1]])
    H, _ = homographies(A, SQUARE, count)
    np.testing.assert_allclose(zhang_intrinsics(H), [1200**2, 1250**2, 630, 500, 7], rtol=1e-6)


def test_zhang_finds_no_focal_length_in_one_view() -> None:
    H, _ = homographies(SQUARE.matrix, SQUARE, 1)
    assert not (zhang_intrinsics(H)[:2] > 0).all()


# --- the root of f^2 ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("squared", [0.0, -4.0, np.nan, np.inf, -np.inf])
def test_what_has_no_root_is_refused_by_name(squared: float) -> None:
    with pytest.raises(ImaginaryFocalLength, match="finds no focal length in these views; add one"):
        checked_focal_length(squared)
    assert issubclass(ImaginaryFocalLength, DegenerateViews)


def test_the_root() -> None:
    assert checked_focal_length(1.44e6) == 1200


# --- poses -------------------------------------------------------------------------------------------------


def test_poses_are_exact_and_in_front_whatever_the_sign_of_the_homography() -> None:
    H, T = homographies(SQUARE.matrix, SQUARE, 4)
    R, t = poses_from_homographies(H, SQUARE.matrix)
    np.testing.assert_allclose(R, T[:, :3, :3], atol=1e-12)
    np.testing.assert_allclose(t, T[:, :3, 3], atol=1e-12)
    assert (t[:, 2] > 0).all()


def test_poses_of_a_wrong_camera_are_rotations_all_the_same() -> None:
    H, _ = homographies(SQUARE.matrix, SQUARE, 4)
    R, t = poses_from_homographies(H, np.diag([2.0, 2.0, 1.0]) @ SQUARE.matrix)
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1)
    assert (t[:, 2] > 0).all()


@given(st.integers(0, 10_000))
def test_nearest_rotation_is_the_nearest(seed: int) -> None:
    rng = np.random.default_rng(seed)
    M = rng.normal(size=(3, 3))
    R = nearest_rotation(M)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)
    others = nearest_rotation(R + rng.normal(scale=0.1, size=(50, 3, 3)))
    assert np.linalg.norm(R - M) <= np.linalg.norm(others - M, axis=(1, 2)).min() + 1e-12
    np.testing.assert_allclose(nearest_rotation(R), R, atol=1e-12)
