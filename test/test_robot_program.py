"""The program of the tutorial, run as it stands against the node and a camera driver."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy")
from live_cell import BAGS, HERE, TIMEOUT_S, Process, robot_cell, wait_until

ROOT = HERE.parent
PROGRAM = ROOT / "doc" / "examples" / "robot_program.py"
TRUTH = json.loads((BAGS / "truth.json").read_text())
STILL = [i for i, frame in enumerate(TRUTH["wrist.bag"]["frames"]) if frame["kind"] == "still"]


def start(cell) -> Process:
    program = Process([sys.executable, str(PROGRAM)], cell.environment)
    cell.stack.callback(program.process.kill)
    return program


def move(program: Process, number: int) -> None:
    program_asks = lambda: sum(line.startswith("Move:") for line in program.out) == number  # noqa: E731
    wait_until(lambda: program_asks() or program.process.poll() is not None, f"move {number}")
    assert program_asks(), program.out + program.err


def arrived(program: Process) -> None:
    program.process.stdin.write("\n")
    program.process.stdin.flush()


def finished(program: Process) -> tuple[int, str]:
    code = program.process.wait(TIMEOUT_S)
    for reader in program.readers:
        reader.join(TIMEOUT_S)
    return code, "".join(program.out)


def test_two_moves_calibrate_the_camera_and_hand_it_to_the_driver(tmp_path: Path) -> None:
    with robot_cell(tmp_path) as cell:
        cell.start_node("--params-file", str(ROOT / "config" / "wrist_camera.yaml"))
        camera = cell.start_camera()
        camera.tell(answer="accept")
        infos = cell.client.camera_info()
        program = start(cell)
        for number, frame in enumerate((STILL[3], STILL[6]), start=1):
            move(program, number)
            camera.tell(hold=frame)
            arrived(program)
        code, out = finished(program)
        assert code == 0, out + "".join(program.err)
        steps = [line.split(":")[0] for line in out.splitlines()]
        assert [step for step in steps if step != "capture"] == [
            "reset",
            "Move",
            "Move",
            "calibrate",
            "save",
            "commit",
        ]
        info = wait_until(lambda: infos, "camera_info")[0]
        true = TRUTH["wrist.bag"]["camera"]
        assert info.k[0] == pytest.approx(true["fx"], rel=0.01)
        assert (tmp_path / "ros/camera_info/wrist_camera.yaml").is_file()
        assert f"640 wide, fx {float(info.k[0])!r}" in out


def test_a_board_that_is_not_there_ends_it_with_the_reason(tmp_path: Path) -> None:
    with robot_cell(tmp_path) as cell:
        cell.start_node("--params-file", str(ROOT / "config" / "wrist_camera.yaml"))
        camera = cell.start_camera()
        camera.tell(hold=0)  # shows no board
        program = start(cell)
        for number in (1, 2, 3):
            move(program, number)
            arrived(program)
        code, out = finished(program)
        assert code == 1
        assert "0 of 3 poses gave a view" in "".join(program.err)
        assert "Traceback" not in "".join(program.err)
        assert "capture: " in out


def test_a_node_that_is_not_there_is_told(tmp_path: Path) -> None:
    with robot_cell(tmp_path) as cell:
        done = subprocess.run(
            [sys.executable, str(PROGRAM)],
            env=cell.environment,
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
        )
    assert done.returncode == 1
    assert "start fewcal_node" in done.stderr
