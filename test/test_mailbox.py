from __future__ import annotations

import threading
from queue import Queue

from fewcal_ros.mailbox import Mailbox


def test_the_newest_win_and_the_others_are_counted():
    box = Mailbox(2)
    for message in "abcd":
        box.put(message)
    assert (box.received, box.dropped) == (4, 2)
    letters = [box.take(), box.take()]
    assert [(letter.number, letter.message) for letter in letters] == [(3, "c"), (4, "d")]
    box.put("e")
    assert box.take().message == "e"
    assert box.dropped == 2


def test_whoever_waits_is_served_or_let_go():
    box = Mailbox(1)
    taken: Queue[object] = Queue()

    def wait() -> None:
        taken.put(box.take())
        taken.put(box.take())

    waiting = threading.Thread(target=wait)
    waiting.start()
    box.put("a")
    assert taken.get(timeout=60).message == "a"
    box.close()
    assert taken.get(timeout=60) is None
    waiting.join(60)
    assert box.closed
    assert box.take() is None


def test_a_closed_box_gives_nothing_out() -> None:
    box = Mailbox(1)
    box.put("a")
    box.close()
    assert box.take() is None
