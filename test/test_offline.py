"""From frames to a calibration: which views are chosen, and what is said of the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from board_frames import PERIOD_NS, Image, empty, flat, pair, shown
from board_pictures import BOARD, CAMERA
from scenes import SIZE, noisy, views_at

from fewcal.boards import Chessboard
from fewcal.calibration import Calibration, calibrate
from fewcal.camera import Camera
from fewcal.constraints import Priors
from fewcal.errors import DegenerateViews
from fewcal.selection import CANDIDATES
from fewcal.session import Session
from fewcal.verdict import Thresholds
from fewcal_ros.messages import Frame
from fewcal_ros.offline import Outcome, Settings, _contradiction, calibrate_frames


def frames_of(images: Sequence[Image], period_ns: int | None = None) -> list[Frame]:
    """Frames named by their index; without a period they have no stamps, like image files."""
    return [
        Frame(image, None if period_ns is None else i * period_ns, "camera", str(i))
        for i, image in enumerate(images)
    ]


def calibrated(images: Sequence[Image], period_ns: int | None = None, **options: Any) -> Outcome:
    outcome = calibrate_frames(frames_of(images, period_ns), Settings(BOARD, **options))
    assert outcome.read == len(outcome.calibration.views) + outcome.rejected.total()
    assert min(outcome.rejected.values(), default=1) > 0
    return outcome


def used(outcome: Outcome) -> list[int]:
    return sorted(int(view.source) for view in outcome.calibration.views)


def test_best_picks_the_informative_pair() -> None:
    good = pair()
    images = [flat(), empty(), good[0], shown(2.0, 50.0), good[1], shown(3.0, seed=1)]
    outcome = calibrated(images)
    assert used(outcome) == [2, 4]
    assert (outcome.read, outcome.with_board) == (6, 5)
    assert outcome.rejected == {"no board": 1, "not selected": 3}
    assert outcome.calibration.verdict.usable
    assert outcome.calibration.verdict.reasons == ()
    fx, std = outcome.calibration.camera.fx, outcome.calibration.std
    assert std is not None
    assert abs(fx - CAMERA.fx) < min(3 * std["fx"], 0.01 * CAMERA.fx)


@pytest.mark.parametrize(("longer", "contradicted"), [(1.0, False), (1.05, True)])
def test_all_good_views_are_held_against_those_chosen(longer: float, contradicted: bool) -> None:
    tilts = (40, 30), (35, 120), (30, -60), (20, 80), (45, 200)
    camera = Camera(1100.0, 1103.0, 650.0, 470.0)
    other = Camera(longer * 1100.0, longer * 1103.0, 650.0, 470.0)
    chosen = calibrate(noisy(views_at(*tilts[:2], camera=camera), 0.2, 1), SIZE)
    together = calibrate(noisy(views_at(*tilts, camera=other), 0.2, 2), SIZE)
    said = _contradiction(chosen, together, Thresholds())
    assert bool(said) == contradicted
    if contradicted:
        assert said.startswith("5 good views together contradict those chosen: fx is 115")
        assert not _contradiction(together, chosen, Thresholds()), "the less sure contradict nobody"
        assert not _contradiction(chosen, together, Thresholds(conflict=np.inf))


@pytest.mark.parametrize("name", ["fx", "fy"])
@pytest.mark.parametrize(("off", "contradicted"), [(2.4, False), (2.6, True), (-2.6, True)])
def test_either_focal_length_contradicts_by_the_bars_of_those_chosen(
    name: str, off: float, contradicted: bool
) -> None:
    tilts = (40, 30), (35, 120), (30, -60), (20, 80), (45, 200)
    chosen, together = (calibrate(noisy(views_at(*tilts[:n]), 0.2, 1), SIZE) for n in (2, 5))
    assert chosen.std is not None
    assert together.std is not None
    assert together.std[name] < chosen.std[name] / 1.2
    there = getattr(chosen.camera, name) + off * chosen.std[name]
    together = replace(together, camera=replace(chosen.camera, **{name: there}))
    said = _contradiction(chosen, together, Thresholds())
    assert bool(said) == contradicted
    assert not contradicted or f"{name} is {there:.1f} +- {together.std[name]:.1f} px" in said


def test_a_focal_length_that_was_stated_is_not_held_against_the_views_as_if_they_said_it() -> None:
    images = [*pair(), shown(30.0), shown(40.0, 200.0)]
    wrong = calibrated(images, priors=Priors(focal_px=(500, 1))).calibration
    assert not wrong.verdict.usable
    assert any("focal length contradicts the stated one of 500 +- 1 px" in r for r in wrong.verdict.reasons)
    assert not any("fx is 50" in reason for reason in wrong.verdict.reasons)


def test_what_most_frames_were_no_use_for_is_said() -> None:
    images = [*pair(), *[shown(30.0, blur_px=4.0, seed=i) for i in range(3)], empty()]
    outcome = calibrated(images)
    assert outcome.calibration.verdict.usable
    (remark,) = outcome.calibration.verdict.reasons
    assert remark.startswith("3 of 6 frames were no use (blurred). ")
    assert calibrated(images[:4]).calibration.verdict.reasons == ()


def test_best_single_view_is_a_tilted_one() -> None:
    assert used(calibrated([flat(), pair()[0], shown(3.0)], views=1)) == [1]


def test_first_stops_when_it_has_enough() -> None:
    looked: list[str] = []
    images = [empty(), *pair(), shown(30.0), flat()]

    def watched() -> Any:
        for frame in frames_of(images):
            looked.append(frame.source)
            yield frame

    outcome = calibrate_frames(watched(), Settings(BOARD, select="first"))
    assert used(outcome) == [1, 2]
    assert looked == ["0", "1", "2"]
    assert (outcome.read, outcome.with_board, outcome.rejected) == (3, 2, {"no board": 1})


def test_first_counts_the_views_it_replaced() -> None:
    outcome = calibrated([flat(), *pair()], select="first", thresholds=Thresholds(focal_std=0.005))
    assert used(outcome) == [1, 2]
    assert outcome.rejected == {"replaced": 1}


def test_all_takes_every_good_view() -> None:
    images = [flat(), empty(), *pair()]
    for select in ("best", "first"):
        assert used(calibrated(images, views=None, select=select)) == [0, 2, 3]


def test_fewer_than_asked_is_said_in_the_verdict() -> None:
    outcome = calibrated(pair(), views=3)
    verdict = outcome.calibration.verdict
    assert verdict.usable  # two good ones do
    assert verdict.reasons == ("Only 2 good views were found, 3 were asked for.",)
    single = calibrated([flat(), empty()]).calibration.verdict
    assert not single.usable
    assert single.reasons[-1] == "Only 1 good view was found, 2 were asked for."


@pytest.mark.parametrize("count", [CANDIDATES + 1, 10_000])
def test_many_views_are_used_when_asked_for(count: int) -> None:
    """However many are asked for, thinning a recording does not stand in the way."""
    images = [shown(20.0, 10.0, shift_px=5.0 * (i - 22)) for i in range(CANDIDATES + 4)]
    outcome = calibrated(images, views=count)
    assert len(outcome.calibration.views) == min(count, len(images))


def test_a_board_that_is_never_still_is_better_than_nothing() -> None:
    """Sharp frames, 6 px apart from each other."""
    images = [shown(40.0, 10.0, shift_px=6.0 * i) for i in range(3)]
    images += [shown(40.0, 100.0, shift_px=6.0 * i) for i in range(3)]
    outcome = calibrated(images, PERIOD_NS)
    first, second = used(outcome)
    assert first < 3 <= second
    assert outcome.rejected == {"not selected": 4}
    assert outcome.calibration.verdict.usable
    (reason,) = outcome.calibration.verdict.reasons
    assert "of the 2 views are of a board in motion" in reason


def test_still_views_are_preferred_to_moving_ones() -> None:
    still = [image for image in pair() for _ in range(2)]
    images = [shown(60.0, 60.0), *still, shown(60.0, 150.0)]
    outcome = calibrated(images, PERIOD_NS, views=2)
    # The first frame of a recording has none before it, and counts as still.
    assert set(used(outcome)) <= {0, 2, 4}
    assert outcome.rejected["moving"] == 3
    assert outcome.calibration.verdict.reasons == ()


def test_with_fewer_still_views_than_asked_for_none_in_motion_are_taken() -> None:
    still = [image for image in pair() for _ in range(2)]
    small = [shown(40.0, 10.0, shift_px=6.0 * i)[8:-8] for i in range(4)]
    outcome = calibrated([empty(), *still, shown(60.0, 150.0), *small], PERIOD_NS, views=3)
    assert outcome.calibration.image_size == (640, 480)
    assert [number in (2, 4) for number in used(outcome)] == [True, True]
    assert outcome.rejected["moving"] == 7
    assert outcome.calibration.verdict.reasons == ("Only 2 good views were found, 3 were asked for.",)


def test_the_size_with_most_good_views_counts() -> None:
    small = [image[8:-8] for image in (*pair(), flat())]
    outcome = calibrated([flat(), *small, empty(), shown(30.0)])
    assert outcome.calibration.image_size == (640, 464)
    assert used(outcome) == [1, 2]
    assert outcome.rejected == {"other size": 2, "no board": 1, "not selected": 1}


@pytest.mark.parametrize("select", ["best", "first"])
def test_images_of_another_camera_on_the_topic_are_left_out(select: str) -> None:
    """As the node does; one camera moves while the board before the other is held still."""
    still, last = pair()
    images = [still, shown(60.0), still, shown(60.0, shift_px=6.0), last, shown(60.0, shift_px=12.0), last]
    both = [
        replace(frame, frame_id=("left", "right")[i % 2])
        for i, frame in enumerate(frames_of(images, PERIOD_NS))
    ]
    alone, mixed = (calibrate_frames(frames, Settings(BOARD, select=select)) for frames in (both[::2], both))
    assert used(mixed) == used(alone) == [0, 6]
    assert mixed.calibration.camera.fx == alone.calibration.camera.fx
    assert mixed.read == len(mixed.calibration.views) + mixed.rejected.total()
    # The other camera's board moves, so that one of its images alone would do; "first" looks at none of them.
    assert mixed.rejected["other camera"] == (3 if select == "first" else 1)
    (reason,) = mixed.calibration.verdict.reasons
    assert "left out, in frame 'right', since the views are in 'left': record each camera on a" in reason
    assert mixed.calibration.verdict.usable
    assert alone.calibration.verdict.reasons == ()


def test_one_view_in_motion_is_said_in_good_grammar() -> None:
    images = [empty(), *(shown(40.0, 10.0, shift_px=6.0 * i) for i in range(3))]
    outcome = calibrated(images, PERIOD_NS, views=1)
    assert outcome.calibration.verdict.reasons[-1].startswith("The view is of a board in motion, which a")


@pytest.mark.parametrize("nameless", [0, 1])
@pytest.mark.parametrize("select", ["best", "first"])
def test_an_image_without_a_frame_id_may_be_of_any_camera(select: str, nameless: int) -> None:
    frames = frames_of([flat(), *pair()])
    frames[nameless] = replace(frames[nameless], frame_id="")
    outcome = calibrate_frames(frames, Settings(BOARD, views=3, select=select))
    assert used(outcome) == [0, 1, 2]
    assert outcome.calibration.verdict.reasons == ()


@pytest.mark.parametrize("select", ["best", "first"])
def test_no_view_names_the_commonest_telling_reason(select: str) -> None:
    board = Chessboard(9, 6, 0.025)
    settings = Settings(Chessboard(10, 7, 0.025), select=select)
    with pytest.raises(DegenerateViews) as caught:
        calibrate_frames(frames_of([empty()] * 3 + [flat()]), settings)
    assert str(caught.value).startswith("None of 4 frames shows chessboard:10x7:0.025 well enough. Found 9x6")
    with pytest.raises(DegenerateViews, match=r"None of 1 frame shows .* No chessboard is to be seen"):
        calibrate_frames(frames_of([empty()]), Settings(board, select=select))
    with pytest.raises(DegenerateViews, match="There is no frame"):
        calibrate_frames([], Settings(board, select=select))


def test_no_view_says_what_was_said_most_often() -> None:
    # The board half hidden comes first; what counts is the size that the other frames show.
    hidden = flat().copy()
    hidden[:, 330:] = 128
    settings = Settings(Chessboard(8, 5, 0.025))
    with pytest.raises(DegenerateViews, match="Found 9x6 interior corners where 8x5"):
        calibrate_frames(frames_of([hidden, flat(), flat()]), settings)


def test_the_choice_of_views_does_not_depend_on_the_method() -> None:
    cameras = [calibrated([flat(), *pair()], method=method).calibration for method in ("map", "zhu2020")]
    assert [view.source for view in cameras[0].views] == [view.source for view in cameras[1].views]
    assert cameras[1].camera.fx == pytest.approx(cameras[0].camera.fx, rel=0.01)
    assert not np.array_equal(cameras[0].camera.intrinsics, cameras[1].camera.intrinsics)


@pytest.mark.parametrize("select", ["best", "first"])
def test_method_and_priors_are_those_of_the_settings(select: str) -> None:
    assert calibrated(pair(), select=select, method="zhu2020").calibration.method == "zhu2020"
    known = calibrated(pair(), select=select, priors=Priors(focal_px=(590.0, 0.1)))
    assert known.calibration.camera.fx == pytest.approx(590, rel=1e-3)


def test_moving_views_are_no_better_than_one_still_view_where_one_is_asked_for() -> None:
    outcome = calibrated([flat(), pair()[0]], PERIOD_NS, views=1)
    assert used(outcome) == [0]
    assert outcome.rejected == {"moving": 1}


def test_a_camera_that_all_good_views_contradict_is_not_usable() -> None:
    images = [*pair(), shown(30.0), shown(40.0, 200.0)]
    stated = calibrated(images, priors=Priors(focal_px=(598.0, 0.5))).calibration
    (reason,) = stated.verdict.reasons
    assert reason.startswith("4 good views together contradict those chosen: fx is 600.")
    assert not stated.verdict.usable


def test_the_choice_of_views_counts_what_is_known() -> None:
    images = [shown(20.0, 10.0), shown(40.0, 10.0), shown(40.0, 30.0), shown(40.0, 100.0)]
    free, known = (
        used(calibrated(images, views=1, priors=p)) for p in (Priors(), Priors(focal_px=(600.0, 0.5)))
    )
    assert free != known


def test_the_first_views_are_sought_until_the_method_chosen_calls_its_camera_usable() -> None:
    # As the live node does, see test_live.py; map would be content with the first.
    images, lenient = [pair()[0], flat(), pair()[1], shown(50.0, 45.0)], Thresholds(focal_std=0.05)
    read = {
        method: calibrated(images, select="first", views=1, method=method, thresholds=lenient).read
        for method in ("map", "zhu2020")
    }
    assert read == {"map": 1, "zhu2020": 4}


def test_zhang_chooses_among_more_views_than_asked_for() -> None:
    outcome = calibrated([flat(), *pair(), shown(30.0, 70.0)], views=3, method="zhang")
    assert len(outcome.calibration.views) == 3


def test_blurred_views_are_no_substitute() -> None:
    outcome = calibrated([pair()[0], *[shown(30.0, 100.0, blur_px=4.0, seed=i) for i in range(2)]])
    assert used(outcome) == [0]
    assert outcome.rejected == {"blurred": 2}


def test_views_that_the_method_cannot_do_are_not_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    calibrate, failures = Session.calibrate, [DegenerateViews("No camera.")]

    def at_first(session: Session) -> Calibration:
        if failures:
            raise failures.pop()
        return calibrate(session)

    monkeypatch.setattr(Session, "calibrate", at_first)
    outcome = calibrated([*pair(), flat()], select="first")
    assert (used(outcome), outcome.read) == ([0, 1], 3)


def test_one_still_view_is_enough_where_all_are_asked_for() -> None:
    assert used(calibrated([flat(), pair()[0]], PERIOD_NS, views=None)) == [0]


def test_zhang_stops_when_it_has_enough() -> None:
    images = [*pair(), shown(30.0), flat(), empty()]
    assert calibrated(images, select="first", views=3, method="zhang").read == 3
