"""Ending on SIGINT and SIGTERM: a wait that they cut short."""

from __future__ import annotations

import select
import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Wait = Callable[[float], bool]
"""Waits so many seconds; True at once when the process has been asked to end."""

_LONGEST_WAIT_S = 1e6
"""A damaged time can lie centuries ahead, which is more than the system can wait for."""


@contextmanager
def until_signal() -> Iterator[Wait]:
    """Give a wait that SIGINT and SIGTERM cut short; to be used in the main thread.

    The byte that Python writes for a signal stays in the socket, so that every later wait ends at once too.
    No lock is involved, unlike in a threading.Event that a handler sets while the main thread waits for it.
    """
    reader, writer = socket.socketpair()
    with reader, writer:
        writer.setblocking(False)
        descriptor = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
        handlers = {
            number: signal.signal(number, lambda *_: None) for number in (signal.SIGINT, signal.SIGTERM)
        }
        try:
            yield lambda seconds: bool(select.select([reader], [], [], min(seconds, _LONGEST_WAIT_S))[0])
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
            signal.set_wakeup_fd(descriptor)
