"""The state of the live calibration in words and numbers, for diagnostics and for the picture."""

from __future__ import annotations

import math
from collections.abc import Iterator
from enum import Enum

from fewcal.calibration import Calibration

from .messages import OTHER_CAMERA
from .status import Status


class Level(Enum):
    """How well the node is."""

    OK = 0
    WARN = 1
    ERROR = 2


def focal_text(calibration: Calibration | None) -> str:
    """The focal length with its error bar, as half a sentence."""
    if calibration is None:
        return "the focal length is not known yet"
    focal, f = calibration.focal_std, calibration.camera.fx
    if focal is None:
        return f"f = {f:.1f} px, without an error bar"
    if not math.isfinite(focal):
        return "the focal length is not determined yet"
    return f"f = {f:.1f} +- {focal * f:.1f} px ({100 * focal:.2g} %, one sigma)"


def judge_health(status: Status) -> tuple[Level, str]:
    """How well the node is, and one sentence about it."""
    if status.idle_s is None:
        return Level.WARN, f"No image has arrived yet. {status.silence}"
    if status.silence:
        return Level.WARN, f"No image has arrived for {status.idle_s:.0f} s. {status.silence}"
    if status.last is not None and status.last.problem:
        return Level.ERROR, status.last.problem
    if status.failure:
        return Level.ERROR, status.failure
    if other := _other_images(status):
        return Level.WARN, other
    if status.last is not None and status.last.decision and status.last.decision.reason == OTHER_CAMERA:
        return Level.WARN, status.last.decision.message
    if status.result is None:
        seen = status.last.decision.message if status.last and status.last.decision else ""
        count = f"{len(status.views)} of {status.parameters.views_required} views"
        return Level.WARN, f"{count}, {focal_text(status.estimate)}. {seen}".strip()
    if status.result.calibration.views != status.views:
        left = len(status.views)
        known = f"{left} view{'s' * (left != 1)} now, {focal_text(status.estimate)}"
        advice = "" if status.parameters.auto_capture else "; call ~/calibrate"
        return Level.WARN, f"The views have changed since the calibration{advice}. {known}."
    verdict = status.result.calibration.verdict
    if not verdict.usable:
        return Level.WARN, "Not usable: " + " ".join(verdict.reasons)
    return Level.OK, f"Calibrated and usable: {focal_text(status.result.calibration)}."


def _other_images(status: Status) -> str:
    """Say when the images are not those that the views were taken from."""
    kind, estimate = status.stream.kind, status.estimate
    if kind is None or estimate is None or kind.size == estimate.image_size:
        return ""
    width, height = estimate.image_size
    return (
        f"The images are {kind.width}x{kind.height} now and the views {width}x{height}; "
        "go back to that size, or call ~/reset."
    )


def health_values(status: Status) -> Iterator[tuple[str, str]]:
    """Every number there is, as (key, value)."""
    parameters = status.parameters
    yield "board", parameters.board
    yield "mode", "automatic" if parameters.auto_capture else "services"
    yield "views", str(len(status.views))
    yield "views required", str(parameters.views_required)
    yield "complete", _yes(status.complete)
    if status.estimate is not None:
        yield "estimated f (px)", f"{status.estimate.camera.fx:.3f}"
        yield "estimated f sd (relative)", _number(status.estimate.focal_std)
    if status.result is None:
        yield "calibrated", "no"
    else:
        yield "calibrated", "yes"
        yield from _calibration_values(status.result.calibration)
    yield "images received", str(status.received)
    yield "images dropped", str(status.dropped)
    yield "images unreadable", str(status.unreadable)
    yield "images looked at", str(status.read)
    yield "images with board", str(status.with_board)
    for reason, count in sorted(status.rejected.items()):
        yield f"rejected: {reason}", str(count)
    yield "last image", _last(status)
    yield "last image took (s)", f"{status.last_took_s:.3f}"
    yield "input", str(status.stream.kind or "none")
    yield "input changes", str(status.stream.changes)
    if status.stream.last_change:
        yield "last input change", status.stream.last_change


def _calibration_values(calibration: Calibration) -> Iterator[tuple[str, str]]:
    for name, value in calibration.camera.parameters.items():
        yield name, repr(value)
    for name, sd in (calibration.std or {}).items():
        yield f"{name} sd", _number(sd)
    yield "f sd (relative)", _number(calibration.focal_std)
    yield "rms (px)", f"{calibration.rms:.4f}"
    yield "method", calibration.method
    yield "image size", "{}x{}".format(*calibration.image_size)
    yield "usable", _yes(calibration.verdict.usable)
    for i, reason in enumerate(calibration.verdict.reasons, 1):
        yield f"reason {i}", reason


def _last(status: Status) -> str:
    if status.last is None:
        return ""
    return status.last.problem or (status.last.decision.message if status.last.decision else "not needed")


def _yes(value: bool) -> str:
    return "yes" if value else "no"


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.6g}"
