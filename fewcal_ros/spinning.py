"""A node's callbacks, served until a signal comes; then an end that leaves nothing running or half done."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from typing import Protocol

import rclpy
from rclpy.exceptions import InvalidHandle
from rclpy.executors import MultiThreadedExecutor

from .signals import Wait

ENDED, FAILED = 0, 1
"""Exit codes: ended by a signal as asked; anything else."""
THREADS = 8
"""One for each callback group that can be busy at once: three that may wait in services, and the others."""
SHUTDOWN_S = 0.5
"""How long the callbacks that still run may take to end."""
_SETTLED_POLL_S = 0.01
POLL_S = 0.2
"""How often to see whether the executor has failed, or is to end."""


class Closable(Protocol):
    """A node with something of its own to end."""

    def close(self) -> None:
        """Let go whatever waits; called before the node is destroyed."""

    def destroy_node(self) -> None:
        """See rclpy.node.Node."""


def run(node: Closable, wait: Wait) -> int:
    """Serve until asked to end, then wind up, and ROS with it.

    Parameters
    ----------
    node : Node with a method close
    wait : callable
        See :func:`fewcal_ros.signals.until_signal`.

    Returns
    -------
    int
        The exit code.
    """
    executor = _Executor(THREADS)
    executor.add_node(node)
    spinner = _Spinner(executor)
    spinner.start()
    while spinner.is_alive() and not wait(POLL_S):
        pass
    # First nothing new is begun, then what waits is let go, then what runs is waited for.
    spinner.end()
    node.close()
    executor.settle(SHUTDOWN_S)
    executor.shutdown(0)
    node.destroy_node()
    rclpy.shutdown()
    if spinner.failure is not None:
        print(f"fewcal_node: {type(spinner.failure).__name__}: {spinner.failure}", file=sys.stderr)
        return FAILED
    return ENDED


class _Executor(MultiThreadedExecutor):  # type: ignore[misc]  # rclpy is not installed wherever this is checked
    """An executor whose callbacks can be waited for, those included that no thread has taken up yet."""

    def settle(self, timeout_s: float) -> None:
        end = time.monotonic() + timeout_s
        while time.monotonic() < end and not all(begun.done() for begun in list(self._futures)):
            time.sleep(_SETTLED_POLL_S)


class _Spinner(threading.Thread):
    """Keeps the executor going until asked to end, or it fails."""

    def __init__(self, executor: MultiThreadedExecutor) -> None:
        super().__init__(name="fewcal executor")
        self._executor = executor
        self._ending = False
        self.failure: Exception | None = None

    def run(self) -> None:
        try:
            while not self._ending:
                # A subscription may be replaced just when the executor is about to wait for it.
                with contextlib.suppress(InvalidHandle):
                    self._executor.spin_once(POLL_S)
        except Exception as error:
            self.failure = error

    def end(self) -> None:
        self._ending = True
        self._executor.wake()
        self.join(SHUTDOWN_S)
