"""Which frames a session keeps, and what it says of the others."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from board_frames import PERIOD_NS, Image, empty, flat, pair, shown
from board_pictures import BOARD, CAMERA, picture, pose
from marker_pictures import CHARUCO, marker_picture, needs_markers, two_parts

from fewcal.boards import Chessboard
from fewcal.camera import Camera
from fewcal.constraints import Priors
from fewcal.detection import Detection
from fewcal.errors import DegenerateViews, InvalidInput
from fewcal.selection import information
from fewcal.session import MOTION_WINDOW_NS, Criteria, Decision, FrameFilter, Session, shift_px
from fewcal.verdict import Thresholds
from fewcal.views import View

BLURRED = 4.0
"""Blur, pixels, whose edges of 10 px are too wide to keep but narrow enough to be found."""


def fates(frames: list[tuple[Image, int | None]]) -> list[str]:
    """Reason for each frame, and a check that the counts agree with them."""
    look = FrameFilter(BOARD)
    decisions = [look.look(image, stamp_ns) for image, stamp_ns in frames]
    assert look.read == len(frames)
    assert look.read == sum(decision.kept for decision in decisions) + look.rejected.total()
    assert look.with_board == sum(decision.detection is not None for decision in decisions)
    assert all(decision.kept == (decision.reason == "kept") for decision in decisions)
    assert all(decision.message.endswith(".") for decision in decisions)
    return [decision.reason for decision in decisions]


def session_of(*images: Image, **options: Any) -> tuple[Session, list[Decision]]:
    session = Session(BOARD, **options)
    return session, [session.add(image) for image in images]


def test_reasons_and_counts() -> None:
    frames = [empty(), shown(30.0), shown(30.0, blur_px=BLURRED), shown(0.0, shift_px=230.0)]
    assert fates([(image, None) for image in frames]) == ["no board", "kept", "blurred", "cut off"]


def test_another_board_is_named() -> None:
    look = FrameFilter(Chessboard(10, 7, 0.025))
    decision = look.look(shown(30.0))
    assert (decision.reason, look.with_board, look.rejected) == ("wrong size", 0, {"wrong size": 1})
    assert "Found 9x6 interior corners where 10x7 were asked for" in decision.message


def test_blur_is_what_the_criteria_say() -> None:
    image = shown(30.0, blur_px=BLURRED)
    assert FrameFilter(BOARD, Criteria(min_sharpness=0.05)).look(image).kept
    refused = FrameFilter(BOARD).look(image)
    assert refused.detection is not None
    assert refused.detection.edge_width_px > 8
    assert "8.0 px are allowed" in refused.message


MOVED_FAR, MOVED_LITTLE = shown(30.0, shift_px=6.0), shown(30.0, shift_px=1.0)


@pytest.mark.parametrize(
    ("moved", "stamps", "second"),
    [
        (MOVED_FAR, (0, PERIOD_NS), "moving"),
        (MOVED_LITTLE, (0, PERIOD_NS), "kept"),
        (MOVED_FAR, (None, None), "kept"),
        (MOVED_FAR, (0, None), "kept"),
        (MOVED_FAR, (None, 0), "kept"),
        (MOVED_FAR, (0, 0), "moving"),
        (MOVED_FAR, (0, MOTION_WINDOW_NS), "moving"),
        (MOVED_FAR, (0, MOTION_WINDOW_NS + 1), "kept"),
        (MOVED_FAR, (PERIOD_NS, 0), "kept"),  # the recording was started again, or clocks were set
    ],
)
def test_stillness(moved: Image, stamps: tuple[int | None, int | None], second: str) -> None:
    assert fates([(shown(30.0), stamps[0]), (moved, stamps[1])]) == ["kept", second]


def test_a_board_that_has_just_appeared_is_not_yet_still() -> None:
    frames = [empty(), shown(30.0), shown(30.0)]
    assert fates([(image, i * PERIOD_NS) for i, image in enumerate(frames)]) == ["no board", "moving", "kept"]
    assert fates([(image, i * 10**9) for i, image in enumerate(frames)]) == ["no board", "kept", "kept"]


@pytest.mark.parametrize(
    ("before", "motion"),
    [(shown(30.0), "kept"), (MOVED_LITTLE, "kept"), (MOVED_FAR, "moving"), (empty(), "moving")],
)
def test_a_frame_that_was_let_pass_tells_motion_too(before: Image, motion: str) -> None:
    frames = FrameFilter(BOARD)
    frames.look(empty(), 0)
    frames.pass_by(before, PERIOD_NS)
    assert frames.look(shown(30.0), 2 * PERIOD_NS).reason == motion
    assert frames.read == 2
    frames.pass_by(MOVED_FAR, 3 * PERIOD_NS)
    assert frames.look(shown(30.0), 3 * PERIOD_NS + 10**9).reason == "kept"  # too long ago
    frames.pass_by(shown(30.0)[:400], 5 * 10**9)
    assert frames.look(shown(30.0), 5 * 10**9 + 1).reason == "moving"  # another size


def test_motion_since_a_frame_that_was_let_pass_is_measured() -> None:
    frames, drift = FrameFilter(BOARD, Criteria(max_motion_px=1.0)), 1.5
    frames.pass_by(shown(30.0, shift_px=drift), 0)
    moved = frames.look(shown(30.0), PERIOD_NS).message
    frames.look(shown(30.0, shift_px=drift), 10 * PERIOD_NS)
    assert frames.look(shown(30.0), 11 * PERIOD_NS).message == moved
    assert moved.startswith("The board moved 1.")


def test_motion_is_measured_from_frame_to_frame() -> None:
    """A slow drift is still, however far it goes: each frame alone is sharp."""
    frames = [(shown(30.0, shift_px=1.5 * i), i * PERIOD_NS) for i in range(4)]
    assert fates(frames) == ["kept"] * 4
    look = FrameFilter(BOARD, Criteria(max_motion_px=1.0))
    assert [look.look(*frame).reason for frame in frames] == ["kept", "moving", "moving", "moving"]


def test_what_is_no_image_is_not_counted() -> None:
    session = Session(BOARD)
    for wrong in (np.zeros((480, 640)), np.zeros((0, 3), np.uint8), np.zeros((4, 4, 2), np.uint8), None):
        with pytest.raises(InvalidInput):
            session.add(wrong)  # type: ignore[arg-type]
    assert (session.frames.read, session.frames.rejected.total()) == (0, 0)


@pytest.mark.parametrize("shape", [(1, 1), (1, 700), (700, 1), (3, 3), (16, 16, 3)])
def test_a_tiny_image_shows_no_board(shape: tuple[int, ...]) -> None:
    assert FrameFilter(BOARD).look(np.full(shape, 90, np.uint8)).reason == "no board"


@pytest.fixture(scope="module")
def complete_session() -> Session:
    session, decisions = session_of(*pair())
    assert [decision.reason for decision in decisions] == ["kept", "kept"]
    return session


def test_informative_views_are_kept_and_make_the_camera(complete_session: Session) -> None:
    session = complete_session
    assert session.complete
    calibration = session.calibrate()
    assert calibration.views == session.views
    assert calibration.verdict.usable
    assert calibration.camera.fx == pytest.approx(CAMERA.fx, rel=0.01)


def test_a_repeat_of_the_same_pose_tells_nothing_new() -> None:
    session, decisions = session_of(
        flat(), shown(1.0, seed=1), shown(1.0, shift_px=1.0), shown(1.0, shift_px=5.0)
    )
    assert [decision.reason for decision in decisions] == ["kept"] + ["nothing new"] * 3
    assert session.frames.rejected == {"nothing new": 3}
    assert len(session.views) == 1


def test_better_views_take_the_place_of_a_poor_first_one() -> None:
    session = Session(BOARD, 2, thresholds=Thresholds(focal_std=0.005))
    for i, image in enumerate((flat(), *pair())):
        assert not session.complete  # one view is too few, and with the flat one two are not usable
        session.add(image, source=str(i))
    assert session.complete
    assert [view.source for view in session.views] == ["1", "2"]
    assert session.add(flat()).reason == "nothing new"


def test_one_view_gives_way_to_a_better_one() -> None:
    session, decisions = session_of(flat(), shown(45.0, 30.0), views_required=1)
    assert [decision.reason for decision in decisions] == ["kept", "replaced"]
    assert decisions[1].kept
    assert len(session.views) == 1
    assert session.calibrate().tilts_deg[0] == pytest.approx(45, abs=2)


def test_complete_only_when_usable() -> None:
    session, _ = session_of(flat(), views_required=1)
    assert not session.calibrate().verdict.usable
    assert not session.complete


def test_one_usable_view_is_not_complete_where_two_are_wanted() -> None:
    session, _ = session_of(pair()[0], views_required=2, thresholds=Thresholds(focal_std=0.5))
    assert session.calibrate().verdict.usable
    assert not session.complete


def test_views_of_another_size_are_refused() -> None:
    session, _ = session_of(flat())
    cropped = shown(40.0, 10.0)[10:-10]
    decision = session.add(cropped)
    assert (decision.kept, decision.reason) == (False, "other size")
    assert "This image is 640x460, the views kept are 640x480" in decision.message
    assert session.capture(cropped).reason == "other size"
    session.remove_last()
    assert session.add(cropped).kept  # with no view left, any size may begin
    assert session.image_size == (640, 460)


def test_capture_keeps_whatever_it_adds_but_no_bad_view() -> None:
    session, _ = session_of(flat())
    assert session.capture(shown(1.0, seed=1)).kept
    again = session.capture(shown(1.0, seed=2))
    assert again.message.startswith("View 3 is kept. It shows the board where view 1 does")
    assert session.capture(empty()).reason == "no board"
    assert session.capture(shown(30.0, blur_px=BLURRED)).reason == "blurred"
    assert len(session.views) == 3


def test_a_capture_of_another_pose_is_not_called_a_repeat() -> None:
    session, _ = session_of(flat())
    assert session.capture(shown(30.0)).message == "View 2 is kept."


def test_remove_last_and_reset() -> None:
    session, _ = session_of(*pair())
    first = session.views[0]
    session.remove_last()
    assert session.views == (first,)
    assert session.calibrate().views == (first,)
    session.remove_last()
    session.remove_last()
    assert session.views == ()
    session.add(flat())
    session.reset()
    assert (session.views, session.image_size, session.frames.read) == ((), None, 0)
    assert session.add(pair()[0]).kept


def test_nothing_kept_is_an_error_with_a_way_out() -> None:
    session, _ = session_of(empty())
    with pytest.raises(DegenerateViews, match="No view has been kept yet; show the board"):
        session.calibrate()


def test_views_survive_every_failure() -> None:
    session = Session(BOARD, method="zhang")  # which one view does not do for
    session.add(flat())
    kept = session.views
    with pytest.raises(DegenerateViews):
        session.calibrate()
    with pytest.raises(InvalidInput):
        session.add(np.zeros((2, 2)))
    assert session.views == kept


def test_another_method_calibrates_from_the_same_views(complete_session: Session) -> None:
    other = Session(BOARD, method="zhu2020")
    for image in pair():
        other.add(image)
    assert other.complete
    assert other.calibrate().method == "zhu2020"
    same = [view.image_points.tobytes() for view in complete_session.views]
    assert [view.image_points.tobytes() for view in other.views] == same


def test_the_same_frames_give_the_same_camera_bit_by_bit(complete_session: Session) -> None:
    cameras = [session.calibrate().camera for session in (complete_session, session_of(*pair())[0])]
    assert cameras[0].intrinsics.tobytes() == cameras[1].intrinsics.tobytes()
    assert cameras[0].distortion.tobytes() == cameras[1].distortion.tobytes()


@pytest.mark.parametrize("count", [0, -1])
def test_no_fewer_than_one_view(count: int) -> None:
    with pytest.raises(InvalidInput, match="views_required must be a whole number, at least 1, not"):
        Session(BOARD, count)


def test_a_usable_camera_does_not_wait_for_a_view_that_tells_much_more() -> None:
    # Real boards are never as flat as the noise model says, so that a second view may promise little.
    demanding = Criteria(max_error_ratio=0.05)
    session = Session(BOARD, criteria=demanding)
    reasons = [session.add(image).reason for image in (shown(60.0, 10.0), shown(42.0, 20.0))]
    assert reasons == ["kept", "kept"]
    assert session.complete
    unusable = Session(BOARD, criteria=demanding)
    assert [unusable.add(image).reason for image in (flat(), shown(8.0, 10.0))] == ["kept", "nothing new"]


# --- boards of which each frame shows another part ---------------------------------------------------------


def part(shift_px: float) -> Image:
    """The board farther and farther beyond the right border."""
    return marker_picture(CHARUCO, 70, 30, 40, shift_px=(shift_px, 0.0))[0]


@needs_markers
def test_parts_of_a_board_make_a_camera() -> None:
    session = Session(CHARUCO)
    decisions = [session.add(image) for image in (*two_parts(), *two_parts())]
    assert [decision.reason for decision in decisions] == ["kept", "kept", "nothing new", "nothing new"]
    assert [len(view) for view in session.views] == [18, 21]
    assert session.complete
    calibration = session.calibrate()
    assert calibration.std is not None
    assert abs(calibration.camera.fx - CAMERA.fx) < min(3 * calibration.std["fx"], 0.01 * CAMERA.fx)


@needs_markers
def test_stillness_is_that_of_the_points_which_both_frames_show() -> None:
    frames = [part(shift) for shift in (196.0, 197.5, 206.0, 206.0)]
    look = FrameFilter(CHARUCO)
    decisions = [look.look(image, i * PERIOD_NS) for i, image in enumerate(frames)]
    counts = [len(decision.detection.view) for decision in decisions if decision.detection is not None]
    assert len(counts) == 4
    assert len(set(counts)) > 1
    assert [decision.reason for decision in decisions] == ["kept", "kept", "moving", "kept"]
    assert "moved 9." in decisions[2].message
    look.pass_by(frames[0], 5 * PERIOD_NS)
    assert look.look(frames[1], 6 * PERIOD_NS).kept
    look.pass_by(frames[0], 7 * PERIOD_NS)
    assert "moved 10." in look.look(frames[2], 8 * PERIOD_NS).message


@needs_markers
def test_a_board_of_which_quite_another_part_is_seen_has_moved() -> None:
    look = FrameFilter(CHARUCO)
    frames = [marker_picture(CHARUCO, 130, 20, 40, shift_px=(x, 0.0))[0] for x in (420.0, -420.0)]
    decisions = [look.look(image, i * PERIOD_NS) for i, image in enumerate(frames)]
    assert [decision.reason for decision in decisions] == ["kept", "moving"]


@pytest.mark.parametrize(
    ("option", "says"),
    [
        ({"views_required": "two"}, "views_required must be a whole number, at least 1, not 'two'"),
        ({"views_required": 1.5}, "views_required must be a whole number"),
        ({"method": "opencv"}, "There is no method 'opencv'"),
        ({"priors": None}, r"priors must be fewcal\.Priors, not None"),
        ({"thresholds": None}, r"thresholds must be fewcal\.Thresholds, not None"),
        ({"criteria": None}, r"criteria must be fewcal\.Criteria, not None"),
        ({"views_required": True}, "views_required must be a whole number"),
        ({"board": "chessboard:9x6:0.025"}, "board must be a fewcal board"),
    ],
)
def test_what_a_session_cannot_work_with_is_said_at_once(option: dict[str, Any], says: str) -> None:
    with pytest.raises(InvalidInput, match=says):
        Session(**{"board": BOARD, **option})
    changed = {"views_required": 2, "method": "map", "thresholds": Thresholds(), "criteria": Criteria()}
    if set(option) <= set(changed):
        session = Session(BOARD)
        with pytest.raises(InvalidInput, match=says):
            session.configure(**{**changed, **option})
        assert (session.views_required, session.method, session.frames.criteria) == (2, "map", Criteria())


@pytest.mark.parametrize("value", [float("nan"), -1.0, "2", None])
def test_numbers_that_are_no_criteria(value: Any) -> None:
    for name in ("min_sharpness", "max_motion_px", "max_error_ratio"):
        with pytest.raises(InvalidInput, match="Criteria are numbers that are not negative"):
            Criteria(**{name: value})


def test_a_view_that_makes_a_usable_camera_unusable_is_no_gain() -> None:
    session = Session(BOARD, criteria=Criteria(max_error_ratio=0.05))
    session.add(shown(60.0, 10.0))
    assert session.calibrate().verdict.usable
    zoomed, _ = picture(pose(BOARD, 30.0, 42.0, 20.0), camera=Camera(780.0, 780.0, 319.5, 239.5))
    assert session.add(zoomed).reason == "nothing new"


def test_what_is_known_beforehand_counts_from_the_first_view() -> None:
    session = Session(BOARD, priors=Priors(focal_px=(590.0, 0.1)))
    for image in pair():
        assert session.add(image).kept
        assert session.estimate is not None
        assert session.estimate.camera.fx == pytest.approx(590, rel=1e-3)


def test_a_view_is_worth_what_it_tells_beyond_what_is_known() -> None:
    images, never = (shown(40.0, 10.0), shown(30.0, 10.0)), Thresholds(focal_std=1e-6)
    for priors, second in ((Priors(), "kept"), (Priors(focal_px=(600.0, 1.0)), "nothing new")):
        _, decisions = session_of(*images, priors=priors, thresholds=never)
        assert [decision.reason for decision in decisions] == ["kept", second]


def test_what_is_asked_for_can_be_changed_and_outlasts_a_reset() -> None:
    session, _ = session_of(*pair())
    session.configure(2, "zhu2020", Thresholds(focal_std=1e-6), Criteria(min_sharpness=0.05))
    assert len(session.views) == 2
    assert not session.complete
    assert not session.calibrate().verdict.usable
    session.reset()
    assert session.add(shown(30.0, blur_px=BLURRED)).kept


def test_a_motion_is_told_by_four_points_or_more() -> None:
    seen = View(BOARD.points, CAMERA.project(BOARD.points, pose(BOARD, 34.0)))
    for count, expected in ((3, np.inf), (4, 5.0)):
        part = View(BOARD.points[:count], seen.image_points[:count] + np.array([3.0, -4.0]))
        assert shift_px(part, seen) == pytest.approx(expected)


class Told:
    """A board that is where it is told to be."""

    def __init__(self, *views: View) -> None:
        self.views = iter(views)

    def detect(self, image: Image, source: str = "", stamp_ns: int | None = None) -> Detection:
        return Detection(next(self.views), 2.0, 30.0)


def test_views_that_make_no_camera_do_no_harm() -> None:
    sound = View(BOARD.points, CAMERA.project(BOARD.points, pose(BOARD, 34.0, 40.0)))
    line = View(BOARD.points, sound.image_points * [1.0, 0.0] + [0.0, 240.0])
    first, second = Session(Told(line)), Session(Told(sound, line))  # type: ignore[arg-type]
    assert first.add(empty()).kept
    assert first.estimate is None
    with pytest.raises(DegenerateViews):
        first.calibrate()
    assert [second.add(empty()).reason for _ in range(2)] == ["kept", "degenerate"]
    assert len(second.views) == 1


def test_a_view_that_is_kept_says_what_is_left_of_the_error() -> None:
    session, (_, second) = session_of(*pair(), views_required=3)
    assert session.estimate is not None
    left = information(session.estimate).projection_std(np.array([[0, 1]]))[0]
    assert second.message == f"The expected projection error is {left:.2f} px now."
