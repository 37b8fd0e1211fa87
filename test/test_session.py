"""Which views a session keeps, and what it says of the others."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from board_frames import Image, empty, flat, pair, shown
from board_pictures import BOARD, CAMERA, picture, pose
from marker_pictures import CHARUCO, needs_markers, two_parts
from test_frame_filter import BLURRED

from fewcal.camera import Camera
from fewcal.constraints import Priors
from fewcal.detection import Detection
from fewcal.errors import DegenerateViews, InvalidInput
from fewcal.frame_filter import Criteria, Decision
from fewcal.selection import information
from fewcal.session import Session
from fewcal.verdict import Thresholds
from fewcal.views import View


def session_of(*images: Image, **options: Any) -> tuple[Session, list[Decision]]:
    session = Session(BOARD, **options)
    return session, [session.add(image) for image in images]


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


def test_boards_apart_are_no_same_view_whatever_motion_is_allowed() -> None:
    session = Session(BOARD, 2, criteria=Criteria(max_motion_px=10_000))
    first, second = pair()
    assert session.add(first).kept
    assert session.capture(second).message == "View 2 is kept."
    session.remove_last()
    assert session.add(second).kept


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


def test_a_reset_forgets_the_estimate() -> None:
    session, _ = session_of(*pair())
    session.reset()
    assert session.estimate is None


def test_a_view_has_to_beat_the_second_look_that_would_tell_most() -> None:
    session = Session(
        BOARD, 3, thresholds=Thresholds(focal_std=1e-6), criteria=Criteria(max_error_ratio=0.97)
    )
    for image in (shown(20.0, 10.0), shown(40.0, 100.0)):
        assert session.capture(image).kept
    assert session.add(shown(35.0, 15.0)).reason == "nothing new"


def test_a_view_that_replaces_none_is_not_kept() -> None:
    # A ratio above one welcomes views that tell little; once there are enough they still have to be better.
    kept, decisions = session_of(*pair(), shown(5.0, 10.0), criteria=Criteria(max_error_ratio=1.5))
    assert [decision.reason for decision in decisions] == ["kept", "kept", "nothing new"]
    assert kept.views == tuple(decision.detection.view for decision in decisions[:2] if decision.detection)


def test_only_a_camera_that_is_usable_already_waits_for_nothing() -> None:
    _, decisions = session_of(flat(), shown(40.0, 10.0), criteria=Criteria(max_error_ratio=0.01))
    assert [decision.reason for decision in decisions] == ["kept", "nothing new"]
