"""The offline road: frames in, the views worth having out, a calibration at the end."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

from fewcal.boards import Board
from fewcal.calibration import Calibration, calibrate
from fewcal.constraints import Priors
from fewcal.errors import BoardNotFound, DegenerateViews, FewcalError
from fewcal.frame_filter import FrameFilter
from fewcal.grey import size_of
from fewcal.selection import CANDIDATES, best_subset, information, thin
from fewcal.session import Session
from fewcal.verdict import Thresholds, Verdict
from fewcal.views import View

from .messages import OTHER_CAMERA, Frame

PAIR = 2
"""Views that make a camera; with fewer of a board held still, those of one in motion are taken as well."""
_Kind = tuple[tuple[int, int], str]
"""Size in pixels and frame_id of an image: one camera in one mode."""


@dataclass(frozen=True)
class Settings:
    """What the user asks for.

    Parameters
    ----------
    board : Board
    views : int or None
        Views to calibrate from; None takes every good one.
    select : {"best", "first"}
        Look at the whole recording and take the views that the posterior likes best, or behave as the live
        node does and stop when there is enough.
    method : {"map", "zhu2020", "zhang"}
    priors : Priors
    thresholds : Thresholds
    """

    board: Board
    views: int | None = 2
    select: str = "best"
    method: str = "map"
    priors: Priors = Priors()
    thresholds: Thresholds = Thresholds()


@dataclass(frozen=True)
class Outcome:
    """A calibration, and what became of the frames.

    Attributes
    ----------
    calibration : Calibration
    read, with_board : int
        Frames looked at, and those of them that showed the board.
    rejected : Counter
        The frames that are not among the views, by reason.
    """

    calibration: Calibration
    read: int
    with_board: int
    rejected: Counter[str]


def calibrate_frames(frames: Iterable[Frame], settings: Settings) -> Outcome:
    """Calibrate from the frames of a recording.

    Raises
    ------
    DegenerateViews
        When no frame shows the board well enough, or the views determine no camera.
    """
    fates = _Fates()
    if settings.select == "first" and settings.views is not None:
        outcome = _first(frames, settings, settings.views, fates)
    else:
        outcome = _best(frames, settings, fates)
    calibration = outcome.calibration
    used, asked = len(calibration.views), settings.views
    if asked is not None and used < asked:
        remark = f"Only {used} good view{'s were' if used > 1 else ' was'} found, {asked} were asked for."
        calibration = _with_remark(calibration, remark)
    if why := fates.of_most():
        calibration = _with_remark(calibration, why)
    return replace(outcome, calibration=calibration)


def _with_remark(calibration: Calibration, remark: str, usable: bool = True) -> Calibration:
    """Add a sentence to the verdict, which does not change it unless the camera is not `usable` for it."""
    verdict = calibration.verdict
    return replace(calibration, verdict=Verdict(verdict.usable and usable, (*verdict.reasons, remark)))


def _first(frames: Iterable[Frame], settings: Settings, count: int, fates: _Fates) -> Outcome:
    """Feed a session, as the live node does, until it has what it needs."""
    session = Session(
        settings.board,
        count,
        method=settings.method,
        priors=settings.priors,
        thresholds=settings.thresholds,
    )
    frame_id, others = "", Counter[str]()
    for frame in frames:
        if frame_id and frame.frame_id not in ("", frame_id):
            session.frames.turn_away(OTHER_CAMERA)
            others[frame.frame_id] += 1
            continue
        decision = session.add(frame.image, frame.stamp_ns, frame.source)
        fates.note(decision.reason, decision.message)
        if decision.kept:
            frame_id = frame_id or frame.frame_id
            if _satisfied(session):
                break
    if not session.views:
        raise fates.no_view(settings.board)
    rejected = session.frames.rejected.copy()
    rejected["replaced"] = session.frames.read - rejected.total() - len(session.views)
    calibration = _beside_others(session.calibrate(), frame_id, others)
    return Outcome(calibration, session.frames.read, session.frames.with_board, +rejected)


def _beside_others(calibration: Calibration, frame_id: str, others: Counter[str]) -> Calibration:
    """Say how many images have another frame_id than the views, of other cameras on the same topic."""
    if not others:
        return calibration
    names, count = " and ".join(map(repr, sorted(others))), others.total()
    were = "images were" if count > 1 else "image was"
    return _with_remark(
        calibration,
        f"{count} {were} left out, in frame {names}, since the views are in {frame_id!r}: record each camera "
        "on a topic of its own.",
    )


def _satisfied(session: Session) -> bool:
    """Whether the views kept make a camera, by the method chosen too, where that has error bars."""
    if not session.complete:
        return False
    try:
        calibration = session.calibrate()
    except FewcalError:
        return False
    return calibration.verdict.usable or calibration.covariance is None


class _Looked(NamedTuple):
    """What all frames showed: good views, those that are good but for motion, and the counts."""

    good: dict[_Kind, list[View]]
    moving: dict[_Kind, list[View]]
    rejected: Counter[str]
    read: int
    with_board: int


def _look_at_all(frames: Iterable[Frame], board: Board, fates: _Fates) -> _Looked:
    # Of each camera on the topic, so that motion is that between images of one.
    looks = defaultdict[str, FrameFilter](lambda: FrameFilter(board))
    good: dict[_Kind, list[View]] = {}
    moving: dict[_Kind, list[View]] = {}
    frame_id = ""
    for frame in frames:
        frame_id = frame.frame_id or frame_id  # without one it may be of any camera
        kind = size_of(frame.image), frame_id
        decision = looks[frame_id].look(frame.image, frame.stamp_ns, frame.source)
        fates.note(decision.reason, decision.message)
        if decision.kept and decision.detection is not None:
            good.setdefault(kind, []).append(decision.detection.view)
        elif decision.reason == "moving" and decision.detection is not None:
            moving.setdefault(kind, []).append(decision.detection.view)
    rejected = sum((look.rejected for look in looks.values()), Counter[str]())
    read = sum(look.read for look in looks.values())
    with_board = sum(look.with_board for look in looks.values())
    return _Looked(good, moving, rejected, read, with_board)


def _best(frames: Iterable[Frame], settings: Settings, fates: _Fates) -> Outcome:
    """Find every good view, then keep the subset that leaves the least uncertainty."""
    good, moving, rejected, read, with_board = _look_at_all(frames, settings.board, fates)
    if max(map(len, good.values()), default=0) < min(settings.views or 1, PAIR) and moving:
        # A board that is never held still, but sharp all the same, is better than no answer. The first frame
        # has none before it, and counts as still whether it is or not.
        for kind, views in moving.items():
            good.setdefault(kind, []).extend(views)
        rejected["moving"] = 0
    if not good:
        raise fates.no_view(settings.board)
    # Images of another size are another camera, or the same one in another mode: the larger group counts.
    size, frame_id = kind = max(good, key=lambda kind: len(good[kind]))
    views = good.pop(kind)
    if frame_id:  # what came before the first frame_id may be of any camera, too
        views = [*good.pop((size, ""), []), *views]
        moving[kind] = [*moving.get((size, ""), []), *moving.get(kind, [])]
    others = Counter({name: len(left) for (other, name), left in good.items() if other == size})
    rejected[OTHER_CAMERA] = others.total()
    rejected["other size"] = sum(map(len, good.values())) - others.total()
    chosen, together = views, None
    if settings.views is not None and len(views) > settings.views:
        chosen, together = _choose(views, size, settings, settings.views)
    rejected["not selected"] = len(views) - len(chosen)
    calibration = calibrate(chosen, size, settings.method, settings.priors, settings.thresholds)
    if together is not None and settings.priors.focal_px is not None:  # what was stated is no view
        priors = replace(settings.priors, focal_px=None)
        together = calibrate(together.views, size, "map", priors, settings.thresholds)
    if together is not None and (contradiction := _contradiction(calibration, together, settings.thresholds)):
        calibration = _with_remark(calibration, contradiction, usable=False)
    calibration = _beside_others(calibration, frame_id, others)
    if in_motion := sum(view in moving.get(kind, []) for view in chosen):
        which = f"{in_motion} of the {len(chosen)} views {'are' if in_motion > 1 else 'is'}"
        calibration = _with_remark(
            calibration,
            f"{which if len(chosen) > 1 else 'The view is'} of a board in motion, which a rolling shutter "
            "distorts; hold it still for half a second at each pose.",
        )
    return Outcome(calibration, read, with_board, +rejected)


def _choose(
    views: list[View], size: tuple[int, int], settings: Settings, count: int
) -> tuple[list[View], Calibration]:
    """Choose so many views, and calibrate from all of them, or from those that differ most."""
    candidates = [views[i] for i in thin(views, max(CANDIDATES, count))]
    together = calibrate(candidates, size, "map", settings.priors, settings.thresholds)
    return [candidates[i] for i in best_subset(information(together, settings.priors), count)], together


def _contradiction(chosen: Calibration, together: Calibration, thresholds: Thresholds) -> str:
    """Say when all good views together speak against the camera of those chosen; empty when they do not."""
    if chosen.std is None or together.std is None:
        return ""
    for name in ("fx", "fy"):
        theirs, sd = getattr(together.camera, name), together.std[name]
        off = abs(getattr(chosen.camera, name) - theirs)
        if sd < chosen.std[name] and off > thresholds.conflict * chosen.std[name]:
            return (
                f"{len(together.views)} good views together contradict those chosen: {name} is "
                f"{theirs:.1f} +- {sd:.1f} px by them, {off / chosen.std[name]:.1f} standard deviations off; "
                "calibrate from all of them (--views all)."
            )
    return ""


class _Fates:
    """Remembers what was said of the frames."""

    def __init__(self) -> None:
        self._said: dict[str, Counter[str]] = {}

    def note(self, reason: str, message: str) -> None:
        self._said.setdefault(reason, Counter())[message] += 1

    def no_view(self, board: Board) -> DegenerateViews:
        """Say why no frame gave a view: the commonest sentence of the commonest reason with a board."""
        if not self._said:
            return DegenerateViews("There is no frame to look at; give a recording or images with some.")
        telling = [reason for reason in self._said if reason != "no board"] or ["no board"]
        sentences = self._said[max(telling, key=lambda reason: self._said[reason].total())]
        return DegenerateViews(
            f"None of {self._total} frame{'s' * (self._total != 1)} shows {board} well enough. "
            f"{sentences.most_common(1)[0][0]}"
        )

    def of_most(self) -> str:
        """Say why most frames that show a board are no use, if they are for one reason; else nothing."""
        with_board = self._total - self._said.get("no board", Counter()).total()
        for reason in set(BoardNotFound.REASONS) - {"no board"}:
            said = self._said.get(reason, Counter())
            if 2 * said.total() > with_board:
                sentence = said.most_common(1)[0][0]
                return f"{said.total()} of {self._total} frames were no use ({reason}). {sentence}"
        return ""

    @property
    def _total(self) -> int:
        return sum(said.total() for said in self._said.values())
