"""What calibrate() takes and refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import BOARD, SIZE, noisy, views_at

from fewcal.calibration import METHODS, calibrate
from fewcal.constraints import Distribution, Normal, Priors, StudentT
from fewcal.errors import DegenerateViews, FewcalError, ImaginaryFocalLength, InvalidInput
from fewcal.views import View

ONE = views_at((40, 30))


@pytest.mark.parametrize("method", ["", "MAP", "opencv", None])
def test_wrong_method(method: str) -> None:
    with pytest.raises(InvalidInput, match=r"There is no method .*; choose one of map, zhu2020, zhang"):
        calibrate(ONE, SIZE, method=method)


@pytest.mark.parametrize("size", [(1280.0, 960), (1280,), (1280, 960, 3), 1280, None, "1280x960"])
def test_image_size_of_the_wrong_kind(size: object) -> None:
    with pytest.raises(InvalidInput, match=r"image_size must be \(width, height\) in pixels, not "):
        calibrate(ONE, size)  # type: ignore[arg-type]


@pytest.mark.parametrize("size", [(0, 960), (1280, -1)])
def test_image_size_of_nothing(size: tuple[int, int]) -> None:
    with pytest.raises(InvalidInput, match="image_size must be positive, not"):
        calibrate(ONE, size)


def test_image_size_beyond_any_camera() -> None:
    with pytest.raises(InvalidInput, match="image_size must be at most 2147483647 pixels"):
        calibrate(ONE, (1280, 10**30))


def test_image_size_of_numpy_integers() -> None:
    found = calibrate(noisy(ONE, 0.2, 1), np.array(SIZE))  # type: ignore[arg-type]
    assert found.image_size == SIZE


@pytest.mark.parametrize("method", METHODS)
def test_no_view(method: str) -> None:
    with pytest.raises(InvalidInput, match="There is no view to calibrate from; give at least one"):
        calibrate([], SIZE, method=method)


@pytest.mark.parametrize("views", [None, 3, ONE[0], [ONE[0], "view"], [(BOARD.points, None)]])
def test_views_of_the_wrong_kind(views: object) -> None:
    with pytest.raises(InvalidInput, match=r"views must be a list of fewcal\.View"):
        calibrate(views, SIZE)  # type: ignore[arg-type]


def test_priors_and_thresholds_of_the_wrong_kind() -> None:
    with pytest.raises(InvalidInput, match=r"priors must be fewcal\.Priors, not 1200"):
        calibrate(ONE, SIZE, priors=1200)  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match=r"thresholds must be fewcal\.Thresholds, not None"):
        calibrate(ONE, SIZE, thresholds=None)  # type: ignore[arg-type]


def test_a_generator_of_views_will_do() -> None:
    found = calibrate((v for v in noisy(ONE, 0.2, 1)), SIZE)  # type: ignore[arg-type]
    assert len(found.views) == 1


PLAIN = noisy(views_at((40, 30), (35, 120)), 0.2, 1)
SPREAD = np.random.default_rng(1).uniform(-12, 12, 54)
HOSTILE = {
    "far outside": [View(v.object_points, v.image_points + 1e6) for v in PLAIN],
    "huge": [View(v.object_points, v.image_points * 1e9) for v in PLAIN],
    "less than a speck": [View(v.object_points, 500 + v.image_points * 1e-14) for v in PLAIN],
    "one place": [View(v.object_points, v.image_points * 1e-12) for v in PLAIN],
    "a speck": [View(v.object_points, 500 + v.image_points * 1e-6) for v in PLAIN],
    "mixed up": [View(v.object_points, v.image_points[np.argsort(SPREAD)]) for v in PLAIN],
    "sigmas of all sizes": [View(v.object_points, v.image_points, 10.0**SPREAD) for v in PLAIN],
    "one far point": [
        View(v.object_points, v.image_points + 1e3 * (np.arange(54) == 5)[:, None]) for v in PLAIN
    ],
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("case", HOSTILE)
@pytest.mark.parametrize("size", [SIZE, (1, 1), (20_000, 15_000)])
def test_whatever_the_points_there_is_a_camera_or_an_error_with_a_name(
    method: str, case: str, size: tuple[int, int]
) -> None:
    try:
        found = calibrate(HOSTILE[case], size, method=method)
    except FewcalError:
        return
    assert np.isfinite([*found.camera.intrinsics, *found.camera.distortion, found.rms, found.sigma_px]).all()
    assert not np.isnan(np.array(list((found.std or {"fx": 1.0}).values()))).any()
    if case != "sigmas of all sizes":
        assert not found.verdict.usable


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("prior", [Normal(50, 0.01), Normal(-1e4, 1), Normal(0, 1e-20), StudentT(1e-6, 1e12)])
@pytest.mark.parametrize(
    "name", ["log_focal_over_width", "log_aspect", "principal_point_y", "tangential", "board_bend"]
)
def test_whatever_the_prior_there_is_a_camera_or_an_error_with_a_name(name: str, prior: Distribution) -> None:
    try:
        found = calibrate(PLAIN, SIZE, priors=replace(Priors(), **{name: prior}))
    except FewcalError:
        return
    assert np.isfinite([*found.camera.intrinsics, *found.camera.distortion, found.rms, found.sigma_px]).all()


def test_points_outside_the_image_are_named() -> None:
    found = calibrate(PLAIN, SIZE[::-1])
    (reason,) = (text for text in found.verdict.reasons if "outside" in text)
    assert reason.startswith("Points lie outside the image of 960x1280")


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (View(BOARD.points[:3], ONE[0].image_points[:3]), "A view has 3 points; four or more"),
        (View(BOARD.points[:9], ONE[0].image_points[:9]), "collinear"),
        (View(BOARD.points, np.full((54, 2), 7.0)), "collinear"),
        (View(np.zeros((0, 3)), np.zeros((0, 2))), "A view has 0 points"),
    ],
)
def test_views_without_a_plane(method: str, bad: View, message: str) -> None:
    with pytest.raises(DegenerateViews, match=message):
        calibrate([ONE[0], bad], SIZE, method=method)


def test_a_view_that_fits_no_camera_is_named() -> None:
    # Three of its four points are on one line, so that no homography is right.
    line = [0, 4, 8, 22]
    (bad,) = noisy([View(BOARD.points[line], ONE[0].image_points[line])], 0.3, 2)
    says = "No camera has view 2 of 3 in front of it; .* off the line through the others"
    with pytest.raises(DegenerateViews, match=says):
        calibrate([PLAIN[0], bad, PLAIN[1]], SIZE)


def test_points_that_do_not_belong_together() -> None:
    square = [[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]]
    crossed = View(square, [[460, 506], [523, 726], [367, 456], [75, 789]])
    with pytest.raises(DegenerateViews, match="check that object and image points belong together"):
        calibrate([crossed], SIZE)


def test_no_focal_length_in_closed_form() -> None:
    with pytest.raises(ImaginaryFocalLength, match='about another axis, or use method "map"'):
        calibrate(ONE, SIZE, method="zhang")
