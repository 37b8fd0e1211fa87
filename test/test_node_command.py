"""The command of the node where ROS 2 is not installed, and before it is imported."""

from __future__ import annotations

import importlib.util
import signal
import subprocess
import sys

import pytest
from interpreter import IMPORT_THAT_IS_INTERRUPTED, run_python

ROS = importlib.util.find_spec("rclpy") is not None


@pytest.mark.skipif(ROS, reason="ROS 2 is installed")
def test_without_ros_it_says_what_to_install() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "fewcal_ros.node_command"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr.startswith("fewcal_node: The node needs ROS 2")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_during_the_imports_ends_it_quietly(number: signal.Signals) -> None:
    code = IMPORT_THAT_IS_INTERRUPTED.format(
        number=int(number), module="fewcal_ros.node", command="fewcal_ros.node_command"
    )
    assert run_python(code) == (0, "", "")


ENDED_TWICE = """
import os, sys, types
class Last:
    def __del__(self, kill=os.kill, own=os.getpid()):
        kill(own, {number})
node = types.ModuleType('fewcal_ros.node')
node.main = lambda: 0
sys.modules['fewcal_ros.node'] = node
from fewcal_ros.node_command import main
sys.last = Last()
sys.exit(main())
"""
"""The second signal is sent by what Python calls last, when it has given all handlers back to the system."""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_it_ends_does_not_count_as_a_crash(number: signal.Signals) -> None:
    assert run_python(ENDED_TWICE.format(number=int(number))) == (0, "", "")
