"""The live road: images are dropped in, one thread looks at them, and services ask for things meanwhile.

A session is never changed under the hands of another thread. Whoever changes it works on a copy, for as long
as that takes, and then puts it in the place of the one that was copied; if that is gone by then, somebody
else (a reset, say) was first, and the work is thrown away. So no lock is held while anything is computed.
"""

from __future__ import annotations

import copy
import threading
import time
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeout
from dataclasses import replace
from typing import Any

from fewcal.detection import prepare
from fewcal.errors import FewcalError
from fewcal.frame_filter import Decision
from fewcal.session import Session
from fewcal.views import View

from .mailbox import Letter, Mailbox
from .messages import OTHER_CAMERA, Frame
from .parameters import Parameters
from .status import Look, Refused, Result, Status, unexpected
from .stream import ImageStream

CAPTURE_TIMEOUT_S = 5.0
"""How long a capture waits for its image: the slowest cameras in use take one every second or two."""
IDLE_S = 5.0
"""Without an image for this long, something is wrong with the driver or the topic."""
GLANCE_PERIOD_S = 0.2
"""How often to look at an image that nobody needs, so that the state tells what the camera sees."""
JOIN_TIMEOUT_S = 1.0
"""How long closing waits for the image being looked at: within the two seconds in which the node must end."""


class LiveCalibration:
    """Looks at images in a thread of its own.

    Parameters
    ----------
    parameters : Parameters
    read : callable
        Makes a Frame of a message; raises a FewcalError when it cannot.
    report : callable
        Called in the worker's thread with the Look at every image.
    watched : callable
        Whether somebody wants to see what is found even when no view is needed any more.
    silence : callable
        Why no image may be arriving, as a sentence that says what to do.
    """

    def __init__(
        self,
        parameters: Parameters,
        read: Callable[[Any], Frame],
        report: Callable[[Look], None],
        watched: Callable[[], bool],
        silence: Callable[[], str],
    ) -> None:
        self._parameters = parameters
        self._read, self._report, self._watched, self._silence = read, report, watched, silence
        self._session = Session(
            parameters.target,
            parameters.views_required,
            parameters.method,
            parameters.priors,
            parameters.thresholds,
            parameters.criteria,
        )
        self._lock = threading.Lock()
        self._mailbox = Mailbox(parameters.queue_size)
        self._stream = ImageStream()
        self._result: Result | None = None
        self._attempted: tuple[View, ...] = ()
        self._frame_ids: dict[View, str] = {}
        self._failure: tuple[tuple[View, ...], str] = (), ""
        self._request: tuple[int, Future[Decision]] | None = None
        self._last: Look | None = None
        self._last_took_s = 0.0
        self._last_arrival: float | None = None
        self._unreadable = 0
        self._last_glance = -GLANCE_PERIOD_S
        self._worker = threading.Thread(target=self._work, name="fewcal worker", daemon=True)
        self._worker.start()

    # What the callbacks of ROS call, each in a thread of its own.

    def offer(self, message: Any) -> None:
        """Drop an image into the mailbox."""
        self._last_arrival = time.monotonic()
        self._mailbox.put(message)

    def capture(self, timeout_s: float = CAPTURE_TIMEOUT_S) -> Decision:
        """Keep the view of the first image that arrives from now on, if it is sharp and still.

        Raises
        ------
        Refused
            When no image comes in time, or another capture is waiting.
        FewcalError
            When the image cannot be read.
        """
        future: Future[Decision] = Future()
        with self._lock:
            if self._mailbox.closed:
                raise Refused("The node is ending.")
            if self._request is not None:
                raise Refused("Another capture is waiting for its image; call again when it has it.")
            number = self._mailbox.received
            self._request = mine = number, future
        try:
            return future.result(timeout_s)
        except FutureTimeout:
            with self._lock:
                claimed = self._request is not mine
                if not claimed:
                    self._request = None
            if claimed:  # its image is being looked at, and the view will be kept or not
                return future.result()
            arrived = self._mailbox.received - number
            raise Refused(
                f"{arrived} images arrived within {timeout_s:g} s, but those before them are still being "
                "looked at; lower queue_size."
                if arrived
                else f"No image arrived within {timeout_s:g} s. {self._silence()}"
            ) from None

    def calibrate(self) -> Result:
        """Calibrate from the views kept so far.

        Raises
        ------
        FewcalError
            When they make no camera.
        """
        return self._calibrate(self._session)

    def reset(self) -> None:
        """Forget every view and the calibration."""
        self._change(Session.reset)
        self._result = None

    def remove_last(self) -> int:
        """Forget the view kept last, and return how many are left.

        Raises
        ------
        Refused
            When there is none.
        """
        if not self._session.views:
            raise Refused("There is no view to remove.")
        return len(self._change(Session.remove_last).views)

    @property
    def result(self) -> Result | None:
        """The calibration, perhaps of other views than those kept now."""
        return self._result

    def current(self) -> Result:
        """The calibration, if it is of the views kept now.

        Raises
        ------
        Refused
            When there is none, or it is of other views.
        """
        result, views = self._result, self._session.views
        if result is None:
            raise Refused("There is no calibration yet; call ~/calibrate when there are enough views.")
        if result.calibration.views != views:
            raise Refused("The views have changed since the calibration; call ~/calibrate again.")
        return result

    def configure(self, parameters: Parameters) -> None:
        """Take over changed parameters; a calibration made by others than these is forgotten."""
        before, self._parameters = self._parameters, parameters
        wanted, had = (
            (each.views_required, each.method, each.thresholds, each.criteria)
            for each in (parameters, before)
        )
        if wanted != had:  # else an image that is being looked at is for the same session
            self._change(lambda session: session.configure(*wanted))
        if (before.method, before.thresholds) != (parameters.method, parameters.thresholds):
            self._result, self._attempted = None, ()

    def status(self) -> Status:
        """Where the calibration stands."""
        session, arrival = self._session, self._last_arrival
        idle_s = None if arrival is None else time.monotonic() - arrival
        return Status(
            parameters=self._parameters,
            views=session.views,
            estimate=session.estimate,
            result=self._result,
            complete=self._satisfied(session),
            failure=self._failure[1] if session.views and self._failure[0] == session.views else "",
            read=session.frames.read,
            with_board=session.frames.with_board,
            rejected=session.frames.rejected.copy(),
            received=self._mailbox.received,
            dropped=self._mailbox.dropped,
            unreadable=self._unreadable,
            stream=self._stream,
            last=self._last,
            last_took_s=self._last_took_s,
            idle_s=idle_s,
            silence=self._silence() if idle_s is None or idle_s > IDLE_S else "",
        )

    def close(self) -> None:
        """End the worker, and let go whoever waits for it."""
        self._mailbox.close()
        with self._lock:
            request, self._request = self._request, None
        if request is not None:
            request[1].set_exception(Refused("The node is ending."))
        self._worker.join(JOIN_TIMEOUT_S)

    # What the worker does.

    def _work(self) -> None:
        prepare()  # half a second, which no capture should wait for
        while (letter := self._mailbox.take()) is not None:
            start = time.monotonic()
            request = self._claim(letter)
            try:
                look = self._look_at(letter, request)
            except Exception as error:  # whatever is wrong with one image, the next may be better
                traceback.print_exc()
                look = Look(letter.message, problem=unexpected(error))
                _answer(request, Refused(look.problem))
            if look.decision is not None or look.problem or self._last is None:
                # What the camera saw last stays known while images pass by that nobody needs.
                self._last, self._last_took_s = look, time.monotonic() - start
            if not self._mailbox.closed:
                try:
                    self._report(look)
                except Exception:  # what cannot be told costs no view
                    traceback.print_exc()

    def _look_at(self, letter: Letter, request: Future[Decision] | None) -> Look:
        try:
            frame = self._read(letter.message)
        except FewcalError as error:
            self._unreadable += 1
            _answer(request, error)
            return Look(letter.message, problem=str(error))
        change = self._stream.note(letter.message, frame)
        try:
            decision, session = self._decide(frame, request is not None)
        except FewcalError as error:
            _answer(request, error)
            problem = "" if isinstance(error, Refused) else str(error)
            return Look(letter.message, frame, problem=problem, stream_change=change)
        _answer(request, decision)
        result, problem = None, ""
        try:
            result = self._by_itself(session)
        except FewcalError as error:
            problem = str(error)
        return Look(letter.message, frame, decision, problem, change, result)

    def _claim(self, letter: Letter) -> Future[Decision] | None:
        """The capture that an image is for, if one was asked for before the image arrived."""
        with self._lock:
            if self._request is None or self._request[0] >= letter.number:
                return None
            (_, future), self._request = self._request, None
            return future

    def _decide(self, frame: Frame, capture: bool) -> tuple[Decision | None, Session]:
        """What the session says to a frame; a view that it keeps is kept."""
        before = self._session
        if other := self._other_camera(frame.frame_id, before):
            before.frames.turn_away(OTHER_CAMERA)
            return Decision(False, OTHER_CAMERA, other), before
        session = copy.copy(before)
        arguments = frame.image, frame.stamp_ns, frame.source
        by_itself = self._parameters.auto_capture and not self._satisfied(session)
        if capture:
            decision = session.capture(*arguments)
        elif by_itself:
            decision = session.add(*arguments)
        elif self._watched() or time.monotonic() - self._last_glance > GLANCE_PERIOD_S:
            self._last_glance = time.monotonic()
            return _unasked(session.frames.look(*arguments)), before
        else:
            session.frames.pass_by(frame.image, frame.stamp_ns)
            return None, before
        if not decision.kept:
            return decision, before
        with self._lock:
            if self._session is before:
                self._session = session
                self._frame_ids = {view: self._frame_ids.get(view, frame.frame_id) for view in session.views}
                return decision, session
        if capture:
            raise Refused("The views were changed while this image was looked at; capture again.")
        return None, before

    def _other_camera(self, frame_id: str, session: Session) -> str:
        """Say that an image is of another camera than the views, if its frame_id does."""
        known = {self._frame_ids.get(view, "") for view in session.views} - {""}
        if not frame_id or not known or frame_id in known:
            return ""
        return (
            f"The image is in frame {frame_id!r}, the views are in {' and '.join(map(repr, sorted(known)))}: "
            "stop what else publishes on the topic, or call ~/reset and start anew."
        )

    def _by_itself(self, session: Session) -> Result | None:
        """Calibrate when there are enough views, once for each set of them."""
        views = session.views
        wanted = self._parameters.auto_capture and len(views) >= self._parameters.views_required
        if not wanted or views == self._attempted:
            return None
        try:
            return self._calibrate(session)
        except Refused:
            return None  # the views were changed meanwhile: whoever did that, or the next image, goes on
        finally:
            if self._session is session:
                self._attempted = views

    def _satisfied(self, session: Session) -> bool:
        """Whether no better view is waited for: those kept make a camera, by the method chosen too."""
        if not session.complete or session.views != self._attempted:
            return session.complete
        result = self._result
        if result is None or result.calibration.views != session.views:
            return False
        # A method without error bars never calls its camera usable; then the word of map stands.
        return result.calibration.verdict.usable or result.calibration.covariance is None

    def _calibrate(self, session: Session) -> Result:
        try:
            calibration = session.calibrate()
        except FewcalError as error:
            self._failure = session.views, str(error)
            raise
        self._failure = (), ""
        with self._lock:
            now = self._session
            if (now.views, now.method, now.thresholds) != (session.views, session.method, session.thresholds):
                raise Refused("The views were changed during the calibration; calibrate again.")
            self._result = Result(calibration, self._frame_ids[session.views[-1]])
            return self._result

    def _change(self, change: Callable[[Session], None]) -> Session:
        """Change the session, again and again until nobody else has changed it meanwhile."""
        while True:
            before = self._session
            session = copy.copy(before)
            change(session)
            with self._lock:
                if self._session is before:
                    self._session = session
                    return session


def _unasked(decision: Decision) -> Decision:
    """The decision on an image that nobody has asked to keep."""
    if not decision.kept:
        return decision
    return replace(
        decision, kept=False, reason="not asked for", message=f"{decision.message} ~/capture would keep it."
    )


def _answer(future: Future[Decision] | None, outcome: Decision | FewcalError | None) -> None:
    """Answer whoever waits, unless that was done or given up."""
    if future is None or future.done():
        return
    if isinstance(outcome, FewcalError):
        future.set_exception(outcome)
    elif outcome is not None:
        future.set_result(outcome)
