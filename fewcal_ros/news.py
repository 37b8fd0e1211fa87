"""What is worth a line in the log: not what was said a moment ago."""

from __future__ import annotations

import re
import time
from collections.abc import Callable

REPEATED_S = 10.0
"""The same sentence is news again after this long, seconds, and what is waited for is told no more often."""
MANY_LOST = 30
"""Images lost on the way, and more than arrived, that are worth a warning: a second of a usual camera."""


class News:
    """Remembers what was told.

    Parameters
    ----------
    clock : callable
        Seconds that never run backwards.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._told: dict[str, float] = {}
        self._awaited = "", clock()
        self._told_loss = False

    def is_new(self, sentence: str) -> bool:
        """Whether a sentence is one that was not told a moment ago, whatever its numbers.

        Images of two kinds may take turns, and no two that are damaged have the same length.
        """
        now, kind = self._clock(), re.sub(r"\d+", "0", sentence)
        self._told = {told: when for told, when in self._told.items() if now - when < REPEATED_S}
        if not sentence or kind in self._told:
            return False
        self._told[kind] = now
        return True

    def is_awaited_anew(self, reason: str) -> bool:
        """Whether another reason to wait is to be told than the last one; empty when nothing is awaited."""
        now, (told, when) = self._clock(), self._awaited
        if not reason:
            self._awaited = "", when
            return False
        new = reason != told and now - when >= REPEATED_S
        if new:
            self._awaited = reason, now
        return new

    def is_loss(self, lost: int, received: int) -> bool:
        """Whether most images are lost on the way; told once."""
        if self._told_loss or lost <= max(received, MANY_LOST):
            return False
        self._told_loss = True
        return True
