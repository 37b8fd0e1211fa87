from __future__ import annotations

import numpy as np
import pytest
from scenes import SIZE, geometry, pose, views_at

from fewcal.adjustment import Geometry
from fewcal.constraints import Priors
from fewcal.parametrisation import ScaleFree
from fewcal.starts import ENUMERATED_VIEWS, _arrangements, _lowest, starting_points
from fewcal.views import View, stack_views

FREE = ScaleFree(SIZE)
TILTS = ((40, 30), (35, 120), (30, -60), (20, 80), (45, 200))


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_starts_are_focal_lengths_with_either_pose_of_each_view(count: int) -> None:
    stack = stack_views(views_at(*TILTS[:count]))
    start = starting_points(stack, FREE, Priors(focal_px=(1234.5, 10)))
    focal, times = np.unique(np.round(np.exp(start.theta[:, 0]), 6), return_counts=True)
    assert 1234.5 in focal
    assert focal.min() < 0.7 * 1280
    assert focal.max() > 4 * 1280
    # Both poses, and with one view both kinds of lenses.
    assert (times == (4 if count == 1 else 2)).all()
    assert len(np.unique(start.theta[start.theta[:, 0] == np.log(1234.5), 4])) == (2 if count == 1 else 1)
    assert (start.position[..., 2] > 0).all()
    # One of them is near the truth.
    off = np.abs(start.rotation - geometry([pose(*tilt) for tilt in TILTS[:count]])[0]).max(axis=(2, 3))
    assert (off.min(axis=0) < 0.05).all()
    for v in range(count):
        angles = start.rotation[:, v] @ np.swapaxes(start.rotation[:1, v], -1, -2)
        assert np.trace(angles, axis1=1, axis2=2).min() < 1 + 2 * np.cos(np.radians(25)), "both poses occur"


def starts_of(lenses: int, views: int) -> Geometry:
    """So many cameras, each with both poses of all views."""
    count = 2 * lenses
    return Geometry(np.zeros((count, 8)), np.zeros((count, views, 3, 3)), np.zeros((count, views, 3)))


def test_arrangements_combine_the_poses_of_few_views_of_one_focal_length() -> None:
    priors = Priors().rows(SIZE)
    source, arrangement = _arrangements(starts_of(2, 2), priors)
    assert source.tolist() == [[0, 0], [0, 1], [1, 0], [1, 1], [2, 2], [2, 3], [3, 2], [3, 3]]
    assert arrangement.tolist() == [0, 1, 2, 3] * 2
    for views in range(1, ENUMERATED_VIEWS + 1):
        assert _arrangements(starts_of(6, views), priors)[0].shape == (6 * 2**views, views)
    assert _arrangements(starts_of(1, ENUMERATED_VIEWS + 1), priors)[0].tolist() == [[0] * 4, [1] * 4]
    # With one view the first cameras have another kind of lens than the last.
    assert _arrangements(starts_of(4, 1), priors)[1].tolist() == [0, 1, 0, 1, 2, 3, 2, 3]


def test_starts_of_a_board_in_another_plane_are_in_its_own_axes() -> None:
    turn = pose(50, 70, 20)[:3, :3]
    (flat,) = views_at(TILTS[0])
    stack = stack_views([View(flat.object_points @ turn.T, flat.image_points)])
    start = starting_points(stack, FREE, Priors())
    rotation = start.rotation[:, 0] @ stack.plane[0].T
    off = np.abs(rotation @ turn - pose(*TILTS[0])[:3, :3]).max(axis=(1, 2))
    assert off.min() < 0.05


def test_the_lowest_of_each_kind_are_kept() -> None:
    values, kinds = np.array([3.0, 1.0, 2.0, 0.0]), np.array([0, 1, 0, 1])
    assert sorted(_lowest(values, kinds, 1).tolist()) == [2, 3]
    assert sorted(_lowest(values, kinds, 2).tolist()) == [0, 1, 2, 3]
