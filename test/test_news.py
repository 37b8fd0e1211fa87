from __future__ import annotations

import pytest

from fewcal_ros.news import MANY_LOST, REPEATED_S, News


class Clock:
    """Stands until it is moved."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


def test_a_sentence_is_new_once_in_a_while(clock: Clock) -> None:
    news = News(clock)
    assert news.is_new("The image is cut off.")
    clock.now += 0.9 * REPEATED_S
    assert not news.is_new("The image is cut off.")
    # Counted from when it was told, not from when it was held back.
    clock.now += 0.2 * REPEATED_S
    assert news.is_new("The image is cut off.")


def test_sentences_that_differ_by_their_numbers_are_one(clock: Clock) -> None:
    news = News(clock)
    assert news.is_new("640x480 instead of 320x240.")
    assert not news.is_new("320x240 instead of 640x480.")
    assert news.is_new("640x480 instead of a thumbnail.")
    clock.now += 1
    assert not news.is_new("640x480 instead of 320x240."), "others between make it no news"


def test_no_sentence_is_no_news(clock: Clock) -> None:
    news = News(clock)
    assert not news.is_new("")
    clock.now += 2 * REPEATED_S
    assert not news.is_new("")


def test_what_is_waited_for_is_told_after_a_while_and_once(clock: Clock) -> None:
    news = News(clock)
    assert not news.is_awaited_anew("the driver"), "it may come at once"
    clock.now += REPEATED_S
    assert news.is_awaited_anew("the driver")
    clock.now += 10 * REPEATED_S
    assert not news.is_awaited_anew("the driver")


def test_other_things_waited_for_are_told_no_more_often_than_that(clock: Clock) -> None:
    news = News(clock)
    clock.now += REPEATED_S
    assert news.is_awaited_anew("a view")
    clock.now += 0.5 * REPEATED_S
    assert not news.is_awaited_anew("another view")
    clock.now += 0.5 * REPEATED_S
    assert news.is_awaited_anew("another view")


def test_what_was_waited_for_once_is_told_again_when_it_is_missing_again(clock: Clock) -> None:
    news = News(clock)
    clock.now += REPEATED_S
    assert news.is_awaited_anew("the driver")
    assert not news.is_awaited_anew("")
    assert not news.is_awaited_anew("the driver"), "a moment ago"
    clock.now += REPEATED_S
    assert news.is_awaited_anew("the driver")


def test_a_loss_is_told_when_most_images_are_lost_and_many_and_once() -> None:
    news = News()
    assert not news.is_loss(MANY_LOST, 0)
    assert not news.is_loss(1000, 1000)
    assert news.is_loss(MANY_LOST + 1, MANY_LOST)
    assert not news.is_loss(5000, 0)
