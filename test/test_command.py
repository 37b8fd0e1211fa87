"""The command before it is imported."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from interpreter import IMPORT_THAT_IS_INTERRUPTED, run_python


def test_an_interrupt_during_the_imports_ends_it_quietly() -> None:
    code = IMPORT_THAT_IS_INTERRUPTED.format(
        number=int(signal.SIGINT), module="fewcal_ros.cli", command="fewcal_ros.command"
    )
    assert run_python(code) == (130, "", "fewcal: Interrupted.\n")


def test_it_is_the_command() -> None:
    code, out, err = run_python(
        "import sys; sys.argv[1:] = ['--help']; from fewcal_ros.command import main; sys.exit(main())"
    )
    assert (code, err) == (0, "")
    assert "calibrate a camera from a recording or images" in out


def test_a_defect_is_not_taken_for_a_camera_that_is_not_usable() -> None:
    code, out, err = run_python(
        "import sys, fewcal_ros.cli as cli; cli._run = lambda arguments: 1 / 0\n"
        "from fewcal_ros.command import main; sys.exit(main())"
    )
    assert (code, out) == (70, "")
    assert "ZeroDivisionError" in err
    assert err.endswith("fewcal: This is a defect of fewcal; please report it with the lines above.\n")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="only Linux has it")
def test_a_defect_that_nobody_can_read_about_keeps_its_exit_code() -> None:
    code, out, _ = run_python(
        "import os, sys, fewcal_ros.cli as cli; cli._run = lambda arguments: 1 / 0\n"
        "os.dup2(os.open('/dev/full', os.O_WRONLY), 2)\n"
        "from fewcal_ros.command import main; sys.exit(main())"
    )
    assert (code, out) == (70, "")
