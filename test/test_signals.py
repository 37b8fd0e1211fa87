from __future__ import annotations

import os
import signal
import threading
import time

import pytest

from fewcal_ros.signals import until_signal


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_wait_and_every_later_one(number):
    with until_signal() as wait:
        assert not wait(0.01)
        threading.Timer(0.05, os.kill, (os.getpid(), number)).start()
        start = time.monotonic()
        assert wait(60)
        assert wait(60)
        assert time.monotonic() - start < 30


def test_many_signals_do_no_harm():
    with until_signal() as wait:
        for _ in range(10_000):
            os.kill(os.getpid(), signal.SIGTERM)
        assert wait(60)


def test_the_handlers_are_those_of_before_afterwards():
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with until_signal() as wait:
        assert signal.getsignal(signal.SIGTERM) != before[1]
        assert not wait(0)
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before
    assert signal.set_wakeup_fd(-1) == -1


def test_a_time_far_ahead_can_be_waited_for():
    with until_signal() as wait:
        os.kill(os.getpid(), signal.SIGINT)
        assert wait(1e18)
