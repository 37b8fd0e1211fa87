"""A node's callbacks, served until a signal comes; then an end that leaves nothing running or half done."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
import traceback
from typing import Protocol

import rclpy
from rclpy.exceptions import InvalidHandle
from rclpy.executors import Executor, ExternalShutdownException, ShutdownException, TimeoutException
from rclpy.service import Service
from rclpy.task import Task

from .signals import Wait

ENDED, FAILED = 0, 1
"""Exit codes: ended by a signal as asked; anything else."""
SHUTDOWN_S = 0.5
"""How long the callbacks that still run may take to end."""
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
    executor = _Executor()
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


class _Executor(Executor):  # type: ignore[misc]  # rclpy is not installed wherever this is checked
    """Runs the callbacks of services, which may wait for something, in a thread each, and all others itself.

    rclpy's MultiThreadedExecutor hands a callback out again and again until its thread has begun it, which
    takes the longer the busier the process is: under large images that kept a core busy for seconds.
    """

    def __init__(self) -> None:
        super().__init__()
        self._serving: list[_Serving] = []

    def spin_once(self, timeout_sec: float | None = None) -> None:
        for ended in [serving for serving in self._serving if not serving.is_alive()]:
            self._serving.remove(ended)
            try:
                ended.callback.result()
            except Exception:  # its caller gets no answer; that is no reason to lose the views
                traceback.print_exc()
        try:
            callback, entity, _ = self.wait_for_ready_callbacks(timeout_sec)
        except (TimeoutException, ShutdownException, ExternalShutdownException):
            return
        if isinstance(entity, Service):
            serving = _Serving(callback)
            self._serving.append(serving)
            serving.begin()
        else:
            callback()
            callback.result()

    def settle(self, timeout_s: float) -> None:
        """Wait for the services that have been called."""
        end = time.monotonic() + timeout_s
        for serving in self._serving:
            serving.join(max(0.0, end - time.monotonic()))


class _Serving(threading.Thread):
    """Runs one callback."""

    def __init__(self, callback: Task) -> None:
        super().__init__(name="fewcal service", daemon=True)
        self.callback = callback
        self._begun = threading.Event()

    def begin(self) -> None:
        """Start, and return when the callback has begun: until then the executor would hand it out again."""
        self.start()
        self._begun.wait()

    def run(self) -> None:
        self._begun.set()
        self.callback()


class _Spinner(threading.Thread):
    """Keeps the executor going until asked to end, or it fails."""

    def __init__(self, executor: Executor) -> None:
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
