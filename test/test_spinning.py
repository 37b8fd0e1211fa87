"""The executor, in a process of its own."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

pytest.importorskip("rclpy")
from ros_domain import own_domain

PROGRAM = """
import sys, threading, time
import rclpy, rclpy.node
from rclpy.callback_groups import ReentrantCallbackGroup
from std_srvs.srv import Trigger
from fewcal_ros import spinning

class Node(rclpy.node.Node):
    def __init__(self):
        super().__init__("spun")
        self.ticks, self.answered, self.released = 0, 0, threading.Event()
        self.create_timer(0.02, self.tick)
        self.create_service(Trigger, "wait", self.wait, callback_group=ReentrantCallbackGroup())
        self.asker = self.create_client(Trigger, "wait", callback_group=ReentrantCallbackGroup())

    def tick(self):
        self.ticks += 1
        {tick}
        if self.ticks in (10, 20, 30)[:{calls}]:
            self.asker.call_async(Trigger.Request()).add_done_callback(self.count)
        if self.ticks == 100:
            self.released.set()

    def count(self, future):
        self.answered += 1

    def wait(self, request, response):
        {wait}
        return response

    def close(self):
        self.released.set()

spins = 0
class Counting(spinning._Executor):
    def spin_once(self, timeout_sec=None):
        global spins
        spins += 1
        super().spin_once(timeout_sec)

spinning._Executor = Counting

def busy():
    while not node.released.is_set():
        sum(range(1000))

rclpy.init()
node = Node()
threading.Thread(target=busy, daemon=True).start()
end = time.monotonic() + 60
def ended(timeout_s):
    time.sleep(timeout_s)
    return node.answered == 2 or time.monotonic() > end
code = spinning.run(node, ended)
print(spins, node.ticks, node.answered, flush=True)
sys.exit(code)
"""


def spin(
    folder: Path, wait: str = "pass", tick: str = "pass", calls: int = 2
) -> subprocess.CompletedProcess[str]:
    program, text = folder / "program.py", textwrap.dedent(PROGRAM)
    for name, code in (("wait", wait), ("tick", tick), ("calls", str(calls))):
        text = text.replace(f"{{{name}}}", code)
    program.write_text(text)
    with own_domain() as environment:
        return subprocess.run(
            [sys.executable, str(program)],
            env=environment,
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )


def test_services_that_wait_keep_neither_the_others_nor_the_processor(tmp_path: Path) -> None:
    # Beside a thread that computes, a callback takes a while to begin; it is handed out once all the same.
    done = spin(tmp_path, wait="self.released.wait(60)")
    assert done.returncode == 0, done.stderr
    spins, ticks, answered = map(int, done.stdout.split())
    assert answered == 2
    assert ticks >= 100
    assert spins < 1.5 * ticks


def test_what_a_service_raises_is_told_and_ends_nothing(tmp_path: Path) -> None:
    done = spin(tmp_path, wait="if self.ticks < 20: raise ValueError('out of order')", calls=3)
    assert done.returncode == 0
    assert done.stdout.split()[2] == "2"
    assert done.stderr.count("ValueError: out of order") == 1


def test_what_another_callback_raises_ends_it_with_a_reason(tmp_path: Path) -> None:
    done = spin(tmp_path, tick="if self.ticks == 5: raise ValueError('out of order')")
    assert done.returncode == 1
    assert done.stderr.strip().endswith("ValueError: out of order")
    assert "Traceback" not in done.stderr
