"""The live road without ROS: the images are arrays, and what is dropped in is looked at by the worker."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from queue import Empty, Queue
from types import SimpleNamespace

import pytest
from board_frames import PERIOD_NS, empty, flat, pair, shown
from board_pictures import BOARD

import fewcal_ros.live
from fewcal.errors import FewcalError, InvalidInput
from fewcal.session import Session
from fewcal_ros.health import Level, health_values, judge_health
from fewcal_ros.live import LiveCalibration
from fewcal_ros.messages import Frame
from fewcal_ros.parameters import Parameters
from fewcal_ros.status import Look, Refused

TIMEOUT_S = 60


class Bench:
    """A live calibration whose looks come out of a queue."""

    def __init__(self, **values: object) -> None:
        self.looks: Queue[Look] = Queue()
        self.gate = threading.Event()
        self.gate.set()
        self.count = 0
        self.frame_id = "camera"
        parameters = Parameters(board=str(BOARD), queue_size=100).changed(values)
        self.live = LiveCalibration(
            parameters, self.read, self.looks.put, lambda: False, lambda: "Nobody is there."
        )

    def read(self, message: SimpleNamespace) -> Frame:
        assert self.gate.wait(TIMEOUT_S)
        if message.image is None:
            raise InvalidInput("This is no image.")
        return Frame(message.image, message.stamp_ns, self.frame_id, "test")

    def offer(self, *images: object, apart_ns: int = 10 * PERIOD_NS) -> None:
        for image in images:
            self.count += 1
            self.live.offer(SimpleNamespace(image=image, stamp_ns=self.count * apart_ns, encoding="mono8"))

    def show(self, *images: object) -> list[Look]:
        self.offer(*images)
        return [self.looks.get(timeout=TIMEOUT_S) for _ in images]

    def capture(self, image: object) -> Queue[object]:
        """Ask for a capture, and show an image once it waits."""
        answers: Queue[object] = Queue()

        def ask() -> None:
            try:
                answers.put(self.live.capture(TIMEOUT_S))
            except FewcalError as error:
                answers.put(error)

        threading.Thread(target=ask, daemon=True).start()
        while self.live._request is None:
            pass
        if image is not None:
            self.show(image)
        return answers


@pytest.fixture
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    bench = Bench(**getattr(request, "param", {}))
    yield bench
    bench.gate.set()
    bench.live.close()
    assert not bench.live._worker.is_alive()


def test_the_same_frames_give_the_camera_of_the_session(bench):
    images = [empty(), flat(), *pair(), flat(), flat()]
    looks = bench.show(*images)
    session = Session(BOARD)
    for i, image in enumerate(images[:4], start=1):
        decision = session.add(image, i * 10 * PERIOD_NS)
        assert looks[i - 1].decision.message == decision.message
        if session.complete:
            break
    result = [look.result for look in looks if look.result][-1]
    assert result.calibration.camera.matrix.tolist() == session.calibrate().camera.matrix.tolist()
    assert bench.live.current() is result
    last = looks[-1].decision  # nothing is looked for any more, but for a glance now and then
    assert last is None or last.reason == "not asked for"
    bench.show(flat())
    level, sentence = judge_health(bench.live.status())
    assert level is Level.OK, sentence
    assert "usable" in sentence
    bench.live.remove_last()
    level, sentence = judge_health(bench.live.status())
    assert sentence.startswith("The views have changed since the calibration. 1 view now, "), "and no advice"


@pytest.mark.parametrize("bench", [{"auto_capture": False}], indirect=True)
class TestByServices:
    def test_captures_one_view_each(self, bench):
        assert not bench.show(flat())[0].result
        assert bench.capture(pair()[0]).get(timeout=TIMEOUT_S).kept
        bench.show(pair()[1], pair()[1])
        assert len(bench.live.status().views) == 1
        assert not bench.capture(empty()).get(timeout=TIMEOUT_S).kept
        assert bench.capture(pair()[1]).get(timeout=TIMEOUT_S).kept
        with pytest.raises(Refused, match="no calibration yet"):
            bench.live.current()
        result = bench.live.calibrate()
        assert result.calibration.verdict.usable
        assert result.frame_id == "camera"
        assert bench.live.remove_last() == 1
        assert "the calibration; call ~/calibrate. 1 view now" in judge_health(bench.live.status())[1]
        with pytest.raises(Refused, match="changed since"):
            bench.live.current()
        bench.live.reset()
        with pytest.raises(Refused, match="no view to remove"):
            bench.live.remove_last()

    def test_an_image_that_came_before_the_call_is_not_captured(self, bench):
        bench.gate.clear()
        bench.offer(flat(), flat())  # the first is being read, the second waits
        answers = bench.capture(None)
        bench.offer(empty())
        bench.gate.set()
        decision = answers.get(timeout=TIMEOUT_S)
        assert decision.reason == "no board"
        assert not bench.live.status().views

    def test_a_reset_wins_over_an_image_that_is_being_looked_at(self, bench):
        bench.gate.clear()
        answers = bench.capture(None)
        looked, go_on = threading.Event(), threading.Event()
        capture = Session.capture

        def slowly(self, *arguments):
            decision = capture(self, *arguments)
            looked.set()
            assert go_on.wait(TIMEOUT_S)
            return decision

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Session, "capture", slowly)
            bench.offer(flat())
            bench.gate.set()
            assert looked.wait(TIMEOUT_S)
            bench.live.reset()
            go_on.set()
            assert "changed while" in str(answers.get(timeout=TIMEOUT_S))
        assert not bench.looks.get(timeout=TIMEOUT_S).problem, "nothing is wrong with the image"
        assert not bench.live.status().views

    def test_a_reset_wins_over_a_calibration_that_is_under_way(self, bench):
        for image in pair():
            assert bench.capture(image).get(timeout=TIMEOUT_S).kept
        calibrate = Session.calibrate

        def meanwhile(session):
            result = calibrate(session)
            bench.live.reset()
            return result

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Session, "calibrate", meanwhile)
            with pytest.raises(Refused, match="changed during the calibration"):
                bench.live.calibrate()
        assert bench.live.result is None

    def test_a_reset_forgets_the_calibration(self, bench):
        assert bench.capture(pair()[0]).get(timeout=TIMEOUT_S).kept
        bench.live.calibrate()
        bench.live.reset()
        with pytest.raises(Refused, match="no calibration yet"):
            bench.live.current()

    def test_an_image_without_a_frame_id_may_be_of_any_camera(self, bench):
        first, second = pair()
        bench.frame_id = "left"
        assert bench.capture(first).get(timeout=TIMEOUT_S).kept
        bench.frame_id = ""
        assert bench.capture(second).get(timeout=TIMEOUT_S).kept

    def test_images_of_another_camera_are_a_warning(self, bench):
        bench.frame_id = "left"
        for image in pair():
            assert bench.capture(image).get(timeout=TIMEOUT_S).kept
        bench.live.calibrate()
        assert judge_health(bench.live.status())[0] is Level.OK
        bench.frame_id = "right"
        bench.show(flat())
        level, sentence = judge_health(bench.live.status())
        assert level is Level.WARN
        assert sentence.startswith("The image is in frame 'right', the views are in 'left'")

    def test_parameters_that_do_not_concern_the_views_disturb_no_capture(self, bench):
        bench.gate.clear()
        answers = bench.capture(None)
        bench.offer(pair()[0])
        before = bench.live._session
        bench.live.configure(bench.live.status().parameters.changed({"output_path": "/tmp/other.yaml"}))
        assert bench.live._session is before
        bench.live.configure(bench.live.status().parameters.changed({"views_required": 5}))
        assert bench.live._session is not before
        bench.gate.set()
        assert answers.get(timeout=TIMEOUT_S)

    def test_motion_is_that_since_an_image_that_passed_by(self, bench):
        bench.offer(shown(30.0), shown(30.0, shift_px=6.0), apart_ns=PERIOD_NS)
        for _ in range(2):
            bench.looks.get(timeout=TIMEOUT_S)
        answers = bench.capture(None)
        bench.offer(shown(30.0), apart_ns=PERIOD_NS)
        assert answers.get(timeout=TIMEOUT_S).reason == "moving"

    def test_a_capture_of_an_image_that_cannot_be_read_says_so(self, bench):
        answers = bench.capture(None)
        bench.show(None)
        assert str(answers.get(timeout=TIMEOUT_S)) == "This is no image."

    def test_the_frame_id_is_that_of_the_last_view_that_is_left(self, bench):
        for frame_id, image in zip(("", "far"), pair(), strict=True):
            bench.frame_id = frame_id
            assert bench.capture(image).get(timeout=TIMEOUT_S).kept
        assert bench.live.calibrate().frame_id == "far"
        bench.live.remove_last()
        assert bench.live.calibrate().frame_id == ""

    def test_a_capture_waits_for_its_image_to_be_looked_at(self, bench):
        """Given up meanwhile, it would say that nothing was kept, and something would be."""
        bench.gate.clear()
        answers: Queue[object] = Queue()
        threading.Thread(target=lambda: answers.put(bench.live.capture(1.0))).start()
        while bench.live._request is None:
            pass
        bench.offer(pair()[0])
        while bench.live._request is not None:
            pass
        with pytest.raises(Empty):
            answers.get(timeout=1.5)
        bench.gate.set()
        assert answers.get(timeout=TIMEOUT_S).kept
        assert len(bench.live.status().views) == 1

    def test_views_are_of_one_camera(self, bench):
        first, second = pair()
        bench.frame_id = "left"
        assert bench.capture(first).get(timeout=TIMEOUT_S).kept
        bench.frame_id = "right"
        refused = bench.capture(second).get(timeout=TIMEOUT_S)
        assert not refused.kept
        assert bench.live.status().rejected["other camera"] == 1
        assert bench.live.status().read == 2
        assert refused.message == (
            "The image is in frame 'right', the views are in 'left': stop what else publishes on the topic, "
            "or call ~/reset and start anew."
        )
        bench.frame_id = "left"
        assert bench.capture(second).get(timeout=TIMEOUT_S).kept
        bench.live.reset()
        bench.frame_id = "right"
        assert bench.capture(first).get(timeout=TIMEOUT_S).kept

    def test_what_the_camera_saw_last_stays_known(self, bench):
        bench.show(*[empty()] * 5)  # of which only the first is looked at, the others follow too soon
        last = bench.live.status().last
        assert last.decision.reason == "no board"
        assert "No chessboard" in dict(health_values(bench.live.status()))["last image"]

    def test_one_capture_at_a_time_and_none_beyond_the_end(self, bench):
        answers = bench.capture(None)
        with pytest.raises(Refused, match="Another capture"):
            bench.live.capture(0)
        bench.live.close()
        assert "ending" in str(answers.get(timeout=TIMEOUT_S))

    def test_a_capture_without_images_is_given_up(self, bench):
        with pytest.raises(Refused, match=r"No image arrived within .* s\. Nobody is there\."):
            bench.live.capture(0.01)
        bench.show(flat())
        assert not bench.live.status().views


def test_an_image_that_cannot_be_read_is_an_error_until_the_next(bench):
    (look,) = bench.show(None)
    assert look.problem == "This is no image."
    status = bench.live.status()
    assert judge_health(status) == (Level.ERROR, "This is no image.")
    assert dict(health_values(status))["images unreadable"] == "1"
    bench.show(empty())
    assert judge_health(bench.live.status())[0] is Level.WARN


def test_a_defect_ends_neither_a_capture_nor_the_worker(bench, monkeypatch, capsys):
    def fail(message):
        raise RuntimeError("unforeseen")

    with monkeypatch.context() as patched:
        patched.setattr(bench.live, "_read", fail)
        answer = bench.capture(pair()[0]).get(timeout=TIMEOUT_S)
    assert isinstance(answer, Refused)
    assert "unforeseen" in str(answer)
    with monkeypatch.context() as patched:
        reported = threading.Event()
        patched.setattr(bench.live, "_report", lambda look: reported.set() or fail(look))
        bench.offer(pair()[0])
        assert reported.wait(TIMEOUT_S)
    bench.show(pair()[1])
    assert len(bench.live.status().views) == 2
    assert capsys.readouterr().err.count("RuntimeError: unforeseen") == 2


def test_a_driver_that_dies_after_an_image_that_cannot_be_read_is_missed(bench):
    bench.show(None)
    gone = replace(bench.live.status(), idle_s=9.0, silence="Nobody is there.")
    assert judge_health(gone) == (Level.WARN, "No image has arrived for 9 s. Nobody is there.")


@pytest.mark.parametrize("bench", [{"auto_capture": False, "method": "zhang"}], indirect=True)
def test_a_calibration_that_failed_is_an_error_until_the_views_change(bench):
    with pytest.raises(FewcalError):
        bench.live.calibrate()
    assert judge_health(bench.live.status())[0] is Level.WARN, "there was nothing to calibrate from"
    assert bench.capture(flat()).get(timeout=TIMEOUT_S).kept
    with pytest.raises(FewcalError) as failure:
        bench.live.calibrate()
    bench.show(empty())
    assert judge_health(bench.live.status()) == (Level.ERROR, str(failure.value))
    assert bench.capture(pair()[0]).get(timeout=TIMEOUT_S).kept
    assert judge_health(bench.live.status())[0] is Level.WARN


@pytest.mark.parametrize(
    "bench", [{"views_required": 1, "method": "zhu2020", "max_focal_std": 0.05}], indirect=True
)
def test_views_are_sought_until_the_method_chosen_calls_its_camera_usable(bench):
    (first,) = bench.show(pair()[0])
    assert first.result is not None
    assert not first.result.calibration.verdict.usable
    assert bench.live.status().estimate.verdict.usable, "map is content"
    assert not bench.live.status().complete
    looks = bench.show(flat(), pair()[1], shown(50.0, 45.0))
    assert all(look.decision.reason in ("nothing new", "replaced") for look in looks)


@pytest.mark.parametrize("bench", [{"views_required": 2, "method": "zhang"}], indirect=True)
def test_a_method_without_error_bars_is_not_sought_views_for_without_end(bench):
    looks = bench.show(*pair(), flat())
    assert [look for look in looks if look.result]
    assert bench.live.status().complete


@pytest.mark.parametrize("bench", [{"views_required": 1}], indirect=True)
def test_other_thresholds_give_another_verdict(bench):
    (look,) = bench.show(pair()[0])
    strict = bench.live.status().parameters.changed({"max_focal_std": 1e-6})
    bench.live.configure(strict)
    with pytest.raises(Refused, match="no calibration yet"):
        bench.live.current()
    (look,) = bench.show(pair()[0])
    assert not look.result.calibration.verdict.usable
    bench.live.configure(strict.changed({"max_focal_std": 1.0}))
    (look,) = bench.show(pair()[0])
    assert look.result.calibration.verdict.usable


@pytest.mark.parametrize("bench", [{"views_required": 1}], indirect=True)
def test_a_result_of_another_method_is_forgotten(bench):
    assert bench.show(pair()[0])[0].result is not None
    bench.live.configure(bench.live.status().parameters.changed({"method": "zhu2020"}))
    with pytest.raises(Refused, match="no calibration yet"):
        bench.live.current()


def test_it_calibrates_once_for_each_set_of_views_and_not_before_there_are_enough(bench):
    looks = bench.show(*pair(), flat(), flat())
    assert [look.result is not None for look in looks] == [False, True, False, False]


def test_silence_is_explained(bench, monkeypatch):
    bench.show(empty())
    assert not bench.live.status().silence
    monkeypatch.setattr(fewcal_ros.live, "IDLE_S", 0.0)
    assert bench.live.status().silence == "Nobody is there."


@pytest.mark.parametrize("bench", [{"auto_capture": False, "method": "zhang"}], indirect=True)
def test_a_failure_is_forgotten_once_the_same_views_make_a_camera(bench):
    assert bench.capture(flat()).get(timeout=TIMEOUT_S).kept
    with pytest.raises(FewcalError):
        bench.live.calibrate()
    bench.live.configure(bench.live.status().parameters.changed({"method": "map"}))
    bench.live.calibrate()
    assert judge_health(bench.live.status())[0] is Level.WARN


@pytest.mark.parametrize("bench", [{"views_required": 1, "max_focal_std": 1e-6}], indirect=True)
def test_a_camera_that_is_not_usable_is_a_warning_with_its_error_bars(bench):
    bench.show(pair()[0])
    level, sentence = judge_health(bench.live.status())
    assert level is Level.WARN
    assert sentence.startswith("Not usable: The focal length is known to ")
    std = bench.live.current().calibration.std
    assert dict(health_values(bench.live.status()))["fx sd"] == f"{std['fx']:.6g}"


def test_images_of_another_size_are_a_warning(bench):
    bench.show(flat(), flat()[10:-10])
    level, sentence = judge_health(bench.live.status())
    assert level is Level.WARN
    assert sentence.startswith("The images are 640x460 now and the views 640x480; go back")


services = pytest.mark.parametrize("bench", [{"auto_capture": False}], indirect=True)
by_itself = pytest.mark.parametrize("bench", [{"views_required": 1}], indirect=True)


@by_itself
def test_thresholds_changed_during_a_calibration_count(bench):
    calibrate, strict = Session.calibrate, bench.live.status().parameters.changed({"max_focal_std": 1e-6})

    def meanwhile(session):
        bench.live.configure(strict)
        return calibrate(session)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Session, "calibrate", meanwhile)
        assert bench.show(pair()[0])[0].result is None
    assert bench.live.result is None
    (look,) = bench.show(pair()[0])
    assert look.result is not None
    assert not look.result.calibration.verdict.usable


@services
def test_a_view_kept_during_a_change_is_not_lost(bench):
    configure, images = Session.configure, [flat()]

    def meanwhile(session, *arguments):
        while images:
            assert bench.capture(images.pop()).get(timeout=TIMEOUT_S).kept
        configure(session, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Session, "configure", meanwhile)
        bench.live.configure(bench.live.status().parameters.changed({"views_required": 3}))
    assert len(bench.live.status().views) == 1


@services
def test_a_capture_wins_over_a_calibration_that_is_under_way(bench):
    assert bench.capture(pair()[0]).get(timeout=TIMEOUT_S).kept
    calibrate = Session.calibrate

    def meanwhile(session):
        result = calibrate(session)
        assert bench.capture(pair()[1]).get(timeout=TIMEOUT_S).kept
        return result

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Session, "calibrate", meanwhile)
        with pytest.raises(Refused, match="changed during the calibration"):
            bench.live.calibrate()
    assert bench.live.result is None


@services
def test_as_many_other_views_are_other_views(bench):
    for image in pair():
        assert bench.capture(image).get(timeout=TIMEOUT_S).kept
    assert bench.live.calibrate() is bench.live.current()
    bench.live.remove_last()
    assert bench.capture(shown(50.0, 45.0)).get(timeout=TIMEOUT_S).kept
    with pytest.raises(Refused, match="changed since"):
        bench.live.current()
    assert judge_health(bench.live.status())[1].startswith("The views have changed since the calibration")


@by_itself
def test_a_defect_after_a_capture_was_answered_does_not_end_the_worker(bench, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(Session, "calibrate", lambda session: 1 / 0)
        assert bench.capture(pair()[0]).get(timeout=TIMEOUT_S).kept
    bench.show(empty())


@pytest.mark.parametrize("bench", [{"views_required": 1, "method": "zhang"}], indirect=True)
def test_a_calibration_by_itself_that_fails_is_no_defect(bench):
    (look,) = bench.show(pair()[0])
    assert look.decision.kept
    assert look.problem
    assert "please report this" not in look.problem


@by_itself
def test_a_reset_during_a_calibration_by_itself_is_no_problem(bench, monkeypatch):
    calibrate = Session.calibrate

    def meanwhile(session):
        bench.live.reset()
        return calibrate(session)

    monkeypatch.setattr(Session, "calibrate", meanwhile)
    (look,) = bench.show(pair()[0])
    assert (look.decision.kept, look.result, look.problem) == (True, None, "")


def test_a_camera_of_other_views_completes_nothing(bench, monkeypatch):
    bench.show(*pair())
    assert bench.live.status().complete
    bench.live.remove_last()

    def fail(session):
        raise FewcalError("No camera.")

    monkeypatch.setattr(Session, "calibrate", fail)
    (look,) = bench.show(shown(50.0, 45.0))
    assert (look.decision.kept, look.problem) == (True, "No camera.")
    assert not bench.live.status().complete


@services
def test_nothing_to_calibrate_from_is_no_error(bench):
    bench.show(empty())
    with pytest.raises(FewcalError, match="No view has been kept"):
        bench.live.calibrate()
    assert judge_health(bench.live.status())[0] is Level.WARN


@services
def test_no_capture_beyond_the_end(bench):
    bench.live.close()
    with pytest.raises(Refused, match="The node is ending"):
        bench.live.capture(0.01)


def test_why_no_image_has_arrived_is_said_from_the_start(bench):
    assert judge_health(bench.live.status()) == (Level.WARN, "No image has arrived yet. Nobody is there.")


@services
def test_somebody_who_watches_sees_every_image_looked_at(bench):
    bench.live._watched = lambda: True
    assert all(look.decision for look in bench.show(*[empty()] * 5))


@services
def test_a_glance_is_one_now_and_then(bench, monkeypatch):
    monkeypatch.setattr(fewcal_ros.live, "GLANCE_PERIOD_S", 600.0)
    bench.live._last_glance = -1e9
    assert [look.decision is not None for look in bench.show(*[empty()] * 3)] == [True, False, False]


@services
def test_enough_views_are_complete_before_anything_is_calibrated(bench):
    for image in pair():
        assert bench.capture(image).get(timeout=TIMEOUT_S).kept
    assert bench.live.status().complete
