from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import CAMERA, SIZE, pose

from fewcal.agreement import Disagreement
from fewcal.camera import Camera
from fewcal.errors import InvalidInput
from fewcal.verdict import (
    Evidence,
    Thresholds,
    Verdict,
    degeneracies,
    extent,
    folds_inside,
    judge,
    outside,
    tilt_deg,
)

Array = NDArray[np.float64]


def rotations(*arrangements: tuple[float, ...]) -> Array:
    """(V, 3, 3) of boards by tilt, axis of the tilt and turn in the board's plane, degrees."""
    return np.stack([pose(*arrangement)[:3, :3] for arrangement in arrangements])


SOUND = Evidence(
    rotations=rotations((40, 20), (35, 110)),
    extents=np.array([0.4, 0.5]),
    copies=np.ones(2),
    outside_px=-7.0,
    camera=CAMERA,
    image_size=SIZE,
    sigma_px=0.5,
    focal_std=0.004,
    conflicts={"focal length": 1.0},
    converged=True,
    view_rms=np.array([0.2, 0.3]),
    disagreement=Disagreement(0.6, 0.2, 0.3, 1),
)

CASES: dict[str, tuple[dict[str, object], str]] = {
    "scatter": (
        {"sigma_px": 4.2},
        "The points miss the camera by so much that one sigma is 4.2 px, more than any board or lens "
        "explains; check that points and board belong together, the board is flat, the lens no fisheye and "
        "every prior true.",
    ),
    "a view of other points": (
        {"sigma_px": 23.0, "view_rms": np.array([0.5, 35.3, 0.54])},
        "The points miss the camera by so much that one sigma is 23 px, more than any board or lens "
        "explains; view 2 misses by 35 px, the others by up to 0.54 px, so leave it out, or check that "
        "points and board belong together, the board is flat, the lens no fisheye and every prior true.",
    ),
    "two cameras": (
        {"disagreement": Disagreement(2.3, 0.12, 1.9, 0)},
        "The views contradict each other: points that fit a camera of each view's own to 0.12 px are moved "
        "by 1.9 px for one of all; check that all are of one camera, whose zoom, focus and image size were "
        "never changed, and of one rigid board.",
    ),
    "a view of another camera": (
        {"disagreement": Disagreement(9.0, 0.12, 4.0, 1), "view_rms": np.ones(3)},
        "The views contradict each other: points that fit a camera of each view's own to 0.12 px are moved "
        "by 4 px for one of all, view 2 most; check that all are of one camera, whose zoom, focus and image "
        "size were never changed, and of one rigid board.",
    ),
    "fronto-parallel": (
        {"rotations": rotations((2, 0), (3.2, 90))},
        "Fronto-parallel: the board is within 4 deg of parallel to the image, which says next to nothing of "
        "the focal length; tilt it by 30 deg or more.",
    ),
    "parallel": (
        {"rotations": rotations((30, 0), (32.5, 0))},
        "Parallel planes: the boards are parallel within 3 deg, so the 2 views count as one; tilt the board "
        "by 30 deg about another axis.",
    ),
    "turned": (
        {"rotations": rotations((30, 0), (30, 0, 70), (30, 0, 20)), "copies": np.ones(3)},
        "Turn about the normal: the board was only turned in its own plane within 1 deg, so the 3 views "
        "count as one; tilt the board by 30 deg about another axis.",
    ),
    "same view": (
        {"rotations": rotations((30, 0), (30, 0), (31, 0)), "copies": np.full(3, 2.9)},
        "The same view again: the 3 views show the board in one place, so they count as one; tilt the board "
        "by 30 deg about another axis.",
    ),
    "small": (
        {"extents": np.array([0.08, 0.123])},
        "Board too small in the image: it spans 12 % of the diagonal; bring it nearer, so that it spans a "
        "third or more.",
    ),
    "no error bars": (
        {"focal_std": None},
        'The method "zhang" has no error bars, so nothing says how well the camera is known; use "map".',
    ),
    "focal length": (
        {"focal_std": 0.0312},
        "The focal length is known to 3.1 % only, 2 % is asked; add a view with the board tilted by 30 to 60 "
        "deg about another axis.",
    ),
    "focal length, just missed": (
        {"focal_std": 0.02008},
        "The focal length is known to 2.01 % only, 2 % is asked; add a view with the board tilted by 30 to "
        "60 deg about another axis.",
    ),
    "a focal length that may be anything": (
        {"focal_std": 8.5},
        "The focal length is not determined, 2 % is asked; add a view with the board tilted by 30 to 60 deg "
        "about another axis.",
    ),
    "no focal length": (
        {"focal_std": float("inf")},
        "The focal length is not determined, 2 % is asked; add a view with the board tilted by 30 to 60 deg "
        "about another axis.",
    ),
    "conflict": (
        {"conflicts": {"aspect ratio": 4.44, "focal length": 2.4}},
        "The aspect ratio contradicts what was known beforehand by 4.4 standard deviations; check that the "
        "board is flat, its squares square, the lens no fisheye and the image neither cropped nor of another "
        "size, add views, or state other priors.",
    ),
    "a stated focal length": (
        {"conflicts": {"focal length": 47.0}, "stated_focal_px": (1210.5, 1.0)},
        "The focal length contradicts the stated one of 1210.5 +- 1 px by 47.0 standard deviations; check "
        "that the board is flat, its squares square, the lens no fisheye and the image neither cropped nor "
        "of another size, add views, or state other priors.",
    ),
    "fold": (
        {"camera": Camera(600.0, 600.0, 639.5, 479.5, [-0.4, 0, 0, 0, 0])},
        "The distortion model folds over 365 px from the principal point, inside the image; add a view with "
        "the board near the corners of the image.",
    ),
    "fold without a radius": (
        {"camera": Camera(600.0, 600.0, 639.5, 479.5, [0, 0, 0.2, 0, 0])},
        "The distortion model folds over inside the image; add a view with the board near the corners of the "
        "image.",
    ),
    "outside": (
        {"outside_px": 41.7},
        "Points lie outside the image of 1280x960, by up to 42 px; check that the size is width and height "
        "of the image that they were found in.",
    ),
    "iterations": ({"converged": False}, "The optimisation did not converge; add a view."),
}


def test_a_sound_calibration_is_usable() -> None:
    assert judge(SOUND) == Verdict(True, ())


@pytest.mark.parametrize("case", CASES)
def test_every_reason_is_given_in_its_own_case_and_no_other(case: str) -> None:
    changes, sentence = CASES[case]
    assert judge(replace(SOUND, **changes)) == Verdict(False, (sentence,))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("known", "asked", "said"),
    [
        (0.02495, 0.0249, "2.5 % only, 2.49 %"),
        (0.02, 0.0199, "2 % only, 1.99 %"),
        (0.0200001, 0.02, "2.00001 % only, 2 %"),
    ],
)
def test_what_is_known_is_said_to_be_beyond_what_is_asked(known: float, asked: float, said: str) -> None:
    (reason,) = judge(replace(SOUND, focal_std=known), Thresholds(focal_std=asked)).reasons
    assert said in reason


def test_more_views_are_no_advice_where_points_do_not_belong_there() -> None:
    apart = replace(SOUND, focal_std=0.03, disagreement=Disagreement(9.0, 0.12, 4.0, 1))
    assert judge(apart).reasons[1] == "The focal length is known to 3 % only, 2 % is asked."


def test_reasons_add_up() -> None:
    changes = {**CASES["small"][0], **CASES["focal length"][0], **CASES["iterations"][0]}
    verdict = judge(replace(SOUND, **changes))  # type: ignore[arg-type]
    assert verdict.reasons == tuple(CASES[case][1] for case in ("small", "focal length", "iterations"))


@pytest.mark.parametrize(
    ("arrangement", "extents"),
    [
        (((40, 20),), (0.4,)),
        (((6, 0),), (0.16,)),
        (((0, 0), (30, 0)), (0.05, 0.3)),
        (((30, 0), (30, 90)), (0.3, 0.3)),
        (((30, 0), (36, 0)), (0.3, 0.3)),
        (((30, 0), (-30, 0)), (0.3, 0.3)),
        (((30, 0), (30, 0), (30, 40)), (0.3, 0.3, 0.3)),
    ],
)
def test_sound_arrangements(arrangement: tuple[tuple[float, ...], ...], extents: tuple[float, ...]) -> None:
    copies = np.ones(len(arrangement))
    assert list(degeneracies(rotations(*arrangement), np.array(extents), copies)) == []


def test_a_board_seen_from_behind_is_parallel_to_itself() -> None:
    (front,) = rotations((30, 20))
    both = np.stack([front, front @ np.diag([1.0, -1.0, -1.0])])
    (reason,) = degeneracies(both, np.full(2, 0.3), np.ones(2))
    assert "parallel" in reason


@pytest.mark.parametrize("roll_deg", [0, 17, 45, 90, 133])
def test_extent_is_the_largest_distance_of_two_points_however_the_board_is_turned(roll_deg: float) -> None:
    c, s = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    grid = np.stack(np.meshgrid(np.arange(9.0), np.arange(6.0)), axis=-1).reshape(-1, 2)
    pixels = 20 * grid @ np.array([[c, s], [-s, c]]) + 300
    assert extent(pixels, (1200, 900)) == pytest.approx(20 * np.hypot(8, 5) / 1500, rel=1.3e-3)


def test_half_a_turn_is_the_ambiguity_of_the_board_and_no_motion() -> None:
    (reason,) = degeneracies(rotations((30, 0), (30, 0, 179)), np.array([0.3, 0.3]), np.ones(2))
    assert reason.startswith("Parallel planes")


@pytest.mark.parametrize(
    ("case", "thresholds"),
    [
        ("fronto-parallel", Thresholds(tilt_deg=1.0, plane_angle_deg=1.0)),
        ("parallel", Thresholds(plane_angle_deg=2.0)),
        ("small", Thresholds(board_extent=0.1)),
        ("focal length", Thresholds(focal_std=0.05)),
        ("conflict", Thresholds(conflict=5.0)),
    ],
)
def test_thresholds_can_be_changed(case: str, thresholds: Thresholds) -> None:
    evidence = replace(SOUND, **CASES[case][0])  # type: ignore[arg-type]
    assert not judge(evidence).usable
    assert judge(evidence, thresholds) == Verdict(True, ())


@pytest.mark.parametrize(("copies", "same"), [((1.4, 1.4), True), ((1.3, 1.3), False), ((2, 2, 1), False)])
def test_views_are_the_same_when_copies_leave_but_one(copies: tuple[float, ...], same: bool) -> None:
    tilted = rotations(*[(30 + 20 * i, 0) for i in range(len(copies))])
    reasons = list(degeneracies(tilted, np.full(len(copies), 0.3), np.array(copies)))
    assert [reason.split(":")[0] for reason in reasons] == ["The same view again"] * same


@pytest.mark.parametrize("wrong", ["2 %", None, float("nan"), 1j])
def test_thresholds_are_numbers(wrong: object) -> None:
    with pytest.raises(InvalidInput, match="Thresholds are numbers"):
        Thresholds(focal_std=wrong)  # type: ignore[arg-type]
    assert judge(SOUND, Thresholds(focal_std=float("inf"))).usable


@pytest.mark.parametrize("share", [0, -0.01])
def test_a_focal_length_is_never_known_better_than_exactly(share: float) -> None:
    with pytest.raises(InvalidInput, match="share of the focal length above zero, not"):
        Thresholds(focal_std=share)


def test_outside_is_measured_from_the_border_of_the_outermost_pixels() -> None:
    inside = np.array([[0.0, 0.0], [99.0, 49.0]])
    assert outside(inside, (100, 50)) == pytest.approx(-0.5)
    assert outside(inside + np.array([3, 0]), (100, 50)) == pytest.approx(2.5)
    assert outside(inside - np.array([0, 7]), (100, 50)) == pytest.approx(6.5)


def test_thresholds_can_be_tightened() -> None:
    verdict = judge(SOUND, Thresholds(focal_std=0.001))
    assert "known to 0.4 % only, 0.1 % is asked" in verdict.reasons[0]
    assert "Board too small" in judge(SOUND, Thresholds(board_extent=0.6)).reasons[0]
    assert "Fronto-parallel" in judge(SOUND, Thresholds(tilt_deg=45)).reasons[0]
    assert "contradicts" in judge(SOUND, Thresholds(conflict=0.5)).reasons[0]


def test_tilt_is_the_angle_to_the_image_plane_from_either_side() -> None:
    found = tilt_deg(rotations((0, 0), (25, 70), (60, -130, 40), (160, 10)))
    np.testing.assert_allclose(found, [0, 25, 60, 20], atol=1e-6)


def test_folds_inside() -> None:
    assert not folds_inside(CAMERA, SIZE)
    lens = Camera(600.0, 600.0, 639.5, 479.5, [-0.4, 0, 0, 0, 0])
    assert folds_inside(lens, SIZE)
    small = Camera(600.0, 600.0, 199.5, 149.5, [-0.4, 0, 0, 0, 0])
    assert not folds_inside(small, (400, 300)), "365 px reach beyond these corners"
    off_centre = Camera(600.0, 600.0, 100.0, 150.0, [-0.4, 0, 0, 0, 0])
    assert folds_inside(off_centre, (500, 300))
    off_centre = Camera(600.0, 600.0, 250.0, 60.0, [-0.4, 0, 0, 0, 0])
    assert folds_inside(off_centre, (500, 380))


def test_a_fold_on_the_way_to_the_border_is_found_where_the_border_itself_has_rays() -> None:
    lens = Camera(348.0, 347.0, 645.0, 503.0, [-0.14310552, 0.00969059, -0.0124726, 0.00268553, 0.0])
    assert folds_inside(lens, SIZE)
    straight = Camera(348.0, 347.0, 645.0, 503.0, [-0.14310552, 0.00969059, 0.0, 0.0, 0.0])
    assert not folds_inside(straight, SIZE), "p1 and p2 make the fold"


@pytest.mark.parametrize(
    ("case", "thresholds"),
    [("scatter", Thresholds(sigma_px=5.0)), ("two cameras", Thresholds(disagreement=2.5))],
)
def test_misfits_are_judged_by_the_thresholds(case: str, thresholds: Thresholds) -> None:
    evidence = replace(SOUND, **CASES[case][0])
    assert not judge(evidence).usable
    assert judge(evidence, thresholds) == Verdict(True, ())


@pytest.mark.parametrize("view_rms", [[0.5, 1.4, 0.54], [0.5, 35.3]])
def test_a_view_is_named_only_where_it_is_one_of_several_and_far_worse(view_rms: list[float]) -> None:
    (reason,) = judge(replace(SOUND, sigma_px=23.0, view_rms=np.array(view_rms))).reasons
    assert "leave it out" not in reason


def test_a_view_that_misses_four_times_as_far_as_the_others_is_named() -> None:
    (reason,) = judge(replace(SOUND, sigma_px=23.0, view_rms=np.array([0.5, 2.0, 0.45]))).reasons
    assert "view 2 misses by 2 px, the others by up to 0.5 px, so leave it out" in reason


def test_only_the_focal_length_contradicts_a_stated_one() -> None:
    evidence = replace(SOUND, conflicts={"aspect ratio": 4.4}, stated_focal_px=(1210.5, 1.0))
    assert "contradicts what was known beforehand" in judge(evidence).reasons[0]


def test_a_corner_at_the_border_is_not_outside() -> None:
    assert judge(replace(SOUND, outside_px=0.9)).usable
    assert not judge(replace(SOUND, outside_px=1.1)).usable


@pytest.mark.parametrize(("sigma_px", "unheld_px"), [(0.02, 0.09), (0.5, 0.45)])
def test_a_camera_that_plumb_bob_does_not_hold_is_refused(sigma_px: float, unheld_px: float) -> None:
    noise = replace(SOUND, sigma_px=sigma_px)
    assert judge(replace(noise, unheld_px=unheld_px)).usable
    (reason,) = judge(replace(noise, unheld_px=1.3 * unheld_px)).reasons
    assert "no place in plumb_bob" in reason
