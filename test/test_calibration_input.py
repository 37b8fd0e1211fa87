"""What calibrate() takes and refuses."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import BOARD, SIZE, noisy, views_at

from fewcal.calibration import METHODS, calibrate
from fewcal.errors import DegenerateViews, ImaginaryFocalLength, InvalidInput
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


def test_points_that_do_not_belong_together() -> None:
    square = [[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]]
    crossed = View(square, [[460, 506], [523, 726], [367, 456], [75, 789]])
    with pytest.raises(DegenerateViews, match="check that object and image points belong together"):
        calibrate([crossed], SIZE)


def test_no_focal_length_in_closed_form() -> None:
    with pytest.raises(ImaginaryFocalLength, match='tilt the board by 30 deg or more, or use method "map"'):
        calibrate(ONE, SIZE, method="zhang")
