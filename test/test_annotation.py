from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from board_frames import pair
from board_pictures import BOARD
from marker_pictures import CHARUCO, needs_markers, two_parts

from fewcal.session import Session
from fewcal.views import View
from fewcal_ros.annotation import (
    AMBER,
    FONT_PX,
    GREEN,
    HEIGHT_PX,
    LINES,
    RED,
    RESIDUAL_SCALE,
    VIOLET,
    WHITE,
    WIDTH_PX,
    Mood,
    annotate,
)


def count(picture, colour):
    return int((np.abs(picture.astype(int) - colour).max(axis=2) < 40).sum())


@pytest.fixture(scope="module")
def session():
    session = Session(BOARD)
    for image in pair():
        assert session.capture(image).kept
    return session


def test_corners_views_and_words_are_drawn(session):
    image = pair()[1]
    bare = annotate(image, [], Mood.BAD)
    height, width = image.shape
    assert bare.shape == (round(height * WIDTH_PX / width) + LINES * FONT_PX + 12, WIDTH_PX, 3)
    assert bare.dtype == np.uint8
    words = annotate(image, ["Failed", "why"], Mood.BAD)
    assert count(bare, RED) == 0 < count(words, RED)
    with_corners = annotate(image, [], Mood.GOOD, session.views[1], True)
    assert count(with_corners, GREEN) > 50 * len(session.views[1]) > count(bare, GREEN)
    everything = annotate(image, [], Mood.GOOD, session.views[1], True, session.estimate)
    assert count(everything, WHITE) > count(with_corners, WHITE) + 100


@needs_markers
def test_a_part_of_a_board_is_drawn():
    session = Session(CHARUCO)
    decisions = [session.add(image) for image in two_parts()]
    found = decisions[1].detection.view
    bare = annotate(two_parts()[1], [], Mood.GOOD)
    picture = annotate(two_parts()[1], [], Mood.GOOD, found, True, session.estimate)
    assert count(picture, GREEN) > 50 * len(found) > count(bare, GREEN)
    assert count(picture, WHITE) > count(bare, WHITE) + 100


def test_the_first_corner_is_drawn_where_it_is(session):
    image, view = pair()[1], session.views[1]
    change = annotate(image, [], Mood.GOOD, view, True) != annotate(image, [], Mood.GOOD)
    x, y = (view.image_points[0] + 0.5) * WIDTH_PX / image.shape[1] - 0.5
    rows, columns = np.nonzero(change.any(axis=2))
    near = np.hypot(columns - x, rows - y) < 12
    assert np.abs([columns[near].mean() - x, rows[near].mean() - y]).max() < 1.5


def test_sixteen_bit_and_any_length_of_text_will_do():
    image = np.zeros((30, 40), np.uint16)
    image[:, 20:] = 1000
    picture = annotate(image, ["long " * 400], Mood.UNDER_WAY)
    assert picture.shape[1] == WIDTH_PX
    assert picture[:600, 600:].min() > 200 > 50 > picture[:600, :300].max()
    assert annotate(np.zeros((1, 5000), np.uint8), [], Mood.GOOD).shape[1] == WIDTH_PX


@pytest.mark.parametrize("shape", [(2000, 16), (2000, 64), (1, 5000)])
def test_narrow_images_stay_small(shape):
    picture = annotate(np.full(shape, 90, np.uint8), ["Words"], Mood.BAD)
    assert picture.shape[1] == WIDTH_PX
    assert picture.shape[0] <= HEIGHT_PX + LINES * FONT_PX + 12


def test_residuals_point_to_where_the_corner_was_seen_a_hundred_times_as_far(session):
    image, view, estimate = pair()[1], session.views[1], session.estimate
    seen, scale = view.image_points.copy(), WIDTH_PX / image.shape[1]
    last = seen[:, 0].argmax()
    seen[last, 0] += 0.3
    moved = replace(estimate, views=(session.views[0], View(view.object_points, seen)))
    picture = annotate(image, [], Mood.GOOD, calibration=moved)
    columns = np.nonzero(np.abs(picture.astype(int) - VIOLET).max(axis=2) < 40)[1]
    assert columns.max() == pytest.approx((seen[last, 0] + 0.3 * RESIDUAL_SCALE) * scale, abs=10)
    cropped = annotate(image[:-1], [], Mood.GOOD, calibration=moved)
    assert count(cropped, VIOLET) == 0, "views of another size are not drawn"


def test_a_board_that_is_not_kept_is_amber(session):
    picture = annotate(pair()[1], [], Mood.GOOD, session.views[1], kept=False)
    assert count(picture, AMBER) > 50 * len(session.views[1])
    assert count(picture, GREEN) == 0
