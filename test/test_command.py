"""The command before it is imported."""

from __future__ import annotations

import signal
import subprocess
import sys


def test_an_interrupt_during_the_imports_ends_it_quietly() -> None:
    # The import of the command is where the signal arrives: sent by a module that takes its place.
    code = (
        "import os, sys, types\n"
        "class Command(types.ModuleType):\n"
        "    def __getattr__(self, name):\n"
        f"        os.kill(os.getpid(), {int(signal.SIGINT)})\n"
        "        raise AttributeError(name)\n"
        "sys.modules['fewcal_ros.cli'] = Command('fewcal_ros.cli')\n"
        "from fewcal_ros.command import main\n"
        "sys.exit(main())\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (130, "fewcal: Interrupted.\n")


def test_it_is_the_command() -> None:
    code = "import sys; sys.argv[1:] = ['--help']; from fewcal_ros.command import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "calibrate a camera from a recording or images" in done.stdout
