"""What a live calibration says of itself: its results, what became of each image, and where it stands."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

from fewcal.calibration import Calibration
from fewcal.errors import FewcalError
from fewcal.frame_filter import Decision
from fewcal.views import View

from .messages import Frame
from .parameters import Parameters
from .stream import ImageStream


class Refused(FewcalError):
    """A request that cannot be granted now; the message says why, and what to do."""


def unexpected(error: Exception) -> str:
    """Sentence about an error that nobody has foreseen."""
    return f"{type(error).__name__}: {error}; please report this."


@dataclass(frozen=True, eq=False)
class Result:
    """A calibration, and the frame_id of the image that gave its last view."""

    calibration: Calibration
    frame_id: str


@dataclass(frozen=True, eq=False)
class Look:
    """What became of one image.

    Attributes
    ----------
    message : sensor_msgs/Image or sensor_msgs/CompressedImage
    frame : Frame or None
        None when the image could not be read.
    decision : Decision or None
        None when it was not looked at: nobody needs it now.
    problem : str
        Why the image, or the calibration from it, failed; empty when nothing did.
    stream_change : str
        How the images differ from those before, as a sentence; commonly empty.
    result : Result or None
        The calibration that this image led to.
    """

    message: Any
    frame: Frame | None = None
    decision: Decision | None = None
    problem: str = ""
    stream_change: str = ""
    result: Result | None = None


@dataclass(frozen=True, eq=False)
class Status:
    """Where the calibration stands.

    `failure` says why there is no camera of the views, when that was tried. `last` is the last image that was
    looked at. `idle_s` is the time since an image arrived, None before the first; `silence` says why none may
    be arriving, and is empty as long as they do.
    """

    parameters: Parameters
    views: tuple[View, ...]
    estimate: Calibration | None
    result: Result | None
    complete: bool
    failure: str
    read: int
    with_board: int
    rejected: Counter[str]
    received: int
    dropped: int
    unreadable: int
    stream: ImageStream
    last: Look | None
    last_took_s: float
    idle_s: float | None
    silence: str
