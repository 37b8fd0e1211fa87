from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import CAMERA, SIZE, noisy, views_at

from fewcal.agreement import disagreement
from fewcal.calibration import calibrate
from fewcal.noise import COMPUTED_PX
from fewcal.views import View

TILTS = (40, 30), (35, 120), (30, -60), (20, 80), (45, 200)


def zoomed(share: float, count: int, seed: int = 1) -> list[View]:
    """Views whose second one is of the same camera with another zoom."""
    other = replace(CAMERA, fx=share * CAMERA.fx, fy=share * CAMERA.fy)
    views, seen = views_at(*TILTS[:count]), views_at(*TILTS[:count], camera=other)
    return noisy([views[0], seen[1], *views[2:]], 0.1, seed)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("count", [2, 3, 5])
def test_views_of_one_camera_agree(count: int, seed: int) -> None:
    found = calibrate(zoomed(1.0, count, seed), SIZE)
    assert found.verdict.usable
    assert not found.verdict.reasons


@pytest.mark.parametrize("method", ["map", "zhu2020"])
@pytest.mark.parametrize("share", [0.8, 1.1, 1.3])
def test_a_view_with_another_zoom_is_named(share: float, method: str) -> None:
    found = calibrate(zoomed(share, 5), SIZE, method=method)
    assert not found.verdict.usable
    assert "The views contradict each other" in found.verdict.reasons[0]
    assert ", view 2 most;" in found.verdict.reasons[0]


def test_what_is_lost_is_compared_with_the_scatter_of_each_view_alone() -> None:
    rng = np.random.default_rng(3)
    counts = np.full(200, 54)
    spare = 2 * 54 - 6 - 8
    # The triangle's last column: what each direction of the camera takes up, then the length of the rest.
    reduced = np.zeros((200, 9, 9))
    reduced[:, :8, -1] = rng.normal(0, 3.0, (200, 8))
    reduced[:, 8, -1] = np.sqrt(rng.chisquare(spare, 200))
    reduced[7, 2, -1] = 40.0
    found = disagreement(reduced, 8, 0.2, counts, np.ones(200))
    assert found is not None
    assert found.alone_px == pytest.approx(0.2, rel=0.02)
    assert found.together_px == pytest.approx(0.2 * np.sqrt(9 + 40**2 / 1600), rel=0.05)
    assert found.ratio == pytest.approx(found.together_px / np.hypot(2 * found.alone_px, 0.3))
    assert found.worst == 7


def test_views_of_few_points_do_not_tell() -> None:
    reduced = np.ones((3, 9, 9))
    reduced[2] = 2
    assert disagreement(reduced, 8, 1.0, np.array([54, 9, 9]), np.ones(3)) is None
    several = disagreement(reduced, 8, 1.0, np.array([54, 9, 54]), np.ones(3))
    assert several is not None
    assert several.worst == 2


def test_two_views_lose_what_one_camera_holds() -> None:
    reduced = np.zeros((3, 9, 9))
    reduced[:, :8, -1], reduced[:, 8, -1] = 3.0, 50.0
    found = disagreement(reduced[:2], 8, 0.5, np.array([54, 54]), np.ones(2))
    assert found is not None
    assert found.together_px == pytest.approx(0.5 * 3 * np.sqrt(2))
    assert found.alone_px == pytest.approx(0.5 * 50 / np.sqrt(2 * 54 - 14))
    assert disagreement(reduced, 8, 0.5, np.array([54, 54, 9]), np.ones(3)) == found
    assert disagreement(reduced, 8, 0.5, np.array([10, 10, 9]), np.ones(3)) is not None
    reduced[:, 8] = 0
    computed = disagreement(reduced, 8, 0.5, np.array([54, 54, 54]), np.ones(3))
    assert computed is not None
    assert computed.alone_px == COMPUTED_PX


def test_copies_do_not_dilute_a_contradiction() -> None:
    rng = np.random.default_rng(4)
    once = rng.normal(0, 3.0, (3, 9, 9))
    once[:, :8, -1] = np.array([[4.0], [3.0], [2.0]])  # the first loses most, all its copies together
    alone = disagreement(once, 8, 0.2, np.full(3, 54), np.ones(3))
    times = np.array([5.0] * 5 + [1.0, 1.0])
    often = once[[0] * 5 + [1, 2]] / np.sqrt(times)[:, None, None]
    found = disagreement(often, 8, 0.2, np.full(7, 54), times)
    assert alone is not None
    assert found is not None
    np.testing.assert_allclose(found[:3], alone[:3])
    assert found.worst == alone.worst == 0
    # One view many times has nobody to disagree with.
    assert disagreement(often[:5], 8, 0.2, np.full(5, 54), times[:5]) is None


@pytest.mark.parametrize("method", ["map", "zhu2020"])
@pytest.mark.parametrize("frames", [1, 2, 20])
def test_frames_from_two_places_do_not_hide_that_the_zoom_was_changed(frames: int, method: str) -> None:
    seen = zoomed(0.8, 2)
    verdict = calibrate(seen[:1] * frames + seen[1:] * frames, SIZE, method).verdict
    assert not verdict.usable
    assert "The views contradict each other" in " ".join(verdict.reasons)
