"""Where images wait for the worker: a few at most, and the newest win."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, eq=False)
class Letter:
    """A message and its place in the order of arrival.

    Attributes
    ----------
    number : int
        1 for the first message that arrived.
    message : object
    """

    number: int
    message: Any


class Mailbox:
    """Holds the newest messages until they are taken, oldest first; a full box drops its oldest.

    Parameters
    ----------
    size : int
        Messages it holds, 1 or more.
    """

    def __init__(self, size: int) -> None:
        self._letters: deque[Letter] = deque(maxlen=size)
        self._changed = threading.Condition()
        self._received = 0
        self._dropped = 0
        self._closed = False

    @property
    def received(self) -> int:
        """Messages that ever arrived."""
        return self._received

    @property
    def dropped(self) -> int:
        """Messages that gave way to newer ones before they were taken."""
        return self._dropped

    @property
    def closed(self) -> bool:
        """Whether nothing will be taken any more."""
        return self._closed

    def put(self, message: Any) -> None:
        """Drop a message in; never waits."""
        with self._changed:
            self._dropped += len(self._letters) == self._letters.maxlen
            self._received += 1
            self._letters.append(Letter(self._received, message))
            self._changed.notify()

    def take(self) -> Letter | None:
        """Take the oldest message, waiting for one; None when the box is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._letters or self._closed)
            return None if self._closed else self._letters.popleft()

    def close(self) -> None:
        """Let whoever waits go; what is in the box stays unread."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
