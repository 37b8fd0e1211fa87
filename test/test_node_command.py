"""The command of the node where ROS 2 is not installed, and before it is imported."""

from __future__ import annotations

import importlib.util
import signal
import subprocess
import sys

import pytest

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
    # The import of the node is where the signal arrives: sent by a module that takes its place.
    code = (
        "import os, sys, types\n"
        "class Node(types.ModuleType):\n"
        "    def __getattr__(self, name):\n"
        f"        os.kill(os.getpid(), {int(number)})\n"
        "        raise AttributeError(name)\n"
        "sys.modules['fewcal_ros.node'] = Node('fewcal_ros.node')\n"
        "from fewcal_ros.node_command import main\n"
        "sys.exit(main())\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_it_ends_does_not_count_as_a_crash(number: signal.Signals) -> None:
    # Sent by what Python calls last, when it has given all handlers of signals back to the system.
    code = (
        "import os, sys, types\n"
        "class Last:\n"
        f"    def __del__(self, kill=os.kill, own=os.getpid()):\n        kill(own, {int(number)})\n"
        "node = types.ModuleType('fewcal_ros.node')\n"
        "node.main = lambda: 0\n"
        "sys.modules['fewcal_ros.node'] = node\n"
        "from fewcal_ros.node_command import main\n"
        "sys.last = Last()\n"
        "sys.exit(main())\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
