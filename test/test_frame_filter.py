"""Which frames are sharp and still, and what is said of the others."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from board_frames import PERIOD_NS, Image, empty, shown
from board_pictures import BOARD, CAMERA, pose
from marker_pictures import CHARUCO, marker_picture, needs_markers

from fewcal.boards import Chessboard
from fewcal.errors import InvalidInput
from fewcal.frame_filter import MOTION_WINDOW_NS, Criteria, FrameFilter, shift_px
from fewcal.session import Session
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


def test_memory_that_is_filled_anew_is_not_taken_for_a_board_held_still() -> None:
    frames, memory = FrameFilter(BOARD), shown(30.0, shift_px=6.0).copy()
    frames.pass_by(memory, 0)
    memory[:] = shown(30.0)
    assert frames.look(memory, PERIOD_NS).reason == "moving"


@pytest.mark.parametrize("stamp", ["now", 1.5, b"1"])
@pytest.mark.parametrize("image", [shown(30.0), empty()])
def test_a_time_that_is_none_is_refused_and_forgotten(image: Image, stamp: Any) -> None:
    frames = FrameFilter(BOARD)
    with pytest.raises(InvalidInput, match="stamp_ns must be a whole number of nanoseconds, or None"):
        frames.look(image, stamp)
    assert frames.look(shown(30.0), 5).kept


def test_what_is_no_image_is_not_counted() -> None:
    session = Session(BOARD)
    for wrong in (np.zeros((480, 640)), np.zeros((0, 3), np.uint8), np.zeros((4, 4, 2), np.uint8), None):
        with pytest.raises(InvalidInput):
            session.add(wrong)  # type: ignore[arg-type]
    assert (session.frames.read, session.frames.rejected.total()) == (0, 0)


@pytest.mark.parametrize("shape", [(1, 1), (1, 700), (700, 1), (3, 3), (16, 16, 3)])
def test_a_tiny_image_shows_no_board(shape: tuple[int, ...]) -> None:
    assert FrameFilter(BOARD).look(np.full(shape, 90, np.uint8)).reason == "no board"


def part(shift_px: float) -> Image:
    """The board farther and farther beyond the right border."""
    return marker_picture(CHARUCO, 70, 30, 40, shift_px=(shift_px, 0.0))[0]


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


@pytest.mark.parametrize("value", [float("nan"), -1.0, "2", None])
def test_numbers_that_are_no_criteria(value: Any) -> None:
    for name in ("min_sharpness", "max_motion_px", "max_error_ratio"):
        with pytest.raises(InvalidInput, match="Criteria are numbers that are not negative"):
            Criteria(**{name: value})


@pytest.mark.parametrize("value", [0, 0.5, float("inf"), 10**400])
def test_numbers_that_are_criteria(value: Any) -> None:
    # What no double holds is as good as infinite.
    Criteria(max_motion_px=value)


def test_a_motion_is_told_by_four_points_or_more() -> None:
    seen = View(BOARD.points, CAMERA.project(BOARD.points, pose(BOARD, 34.0)))
    for count, expected in ((3, np.inf), (4, 5.0)):
        part = View(BOARD.points[:count], seen.image_points[:count] + np.array([3.0, -4.0]))
        assert shift_px(part, seen) == pytest.approx(expected)
