"""What is installed beside the code: the launch file and the parameter files."""

from __future__ import annotations

import ast
import importlib.util
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from ros_domain import own_domain

from fewcal.errors import InvalidInput
from fewcal_ros.parameters import Parameters

ROOT = Path(__file__).resolve().parent.parent
LAUNCH = ROOT / "launch" / "fewcal.launch.py"
CONFIGS = sorted((ROOT / "config").glob("*.yaml"))
TIMEOUT_S = 60


def load_launch_file():
    spec = importlib.util.spec_from_file_location("fewcal_launch", LAUNCH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


launch = load_launch_file()
ABOUT = {about.name: about for about in launch.PARAMETERS}


def parameters_of(config: Path) -> dict:
    (content,) = yaml.safe_load(config.read_text()).values()
    return content["ros__parameters"]


def test_the_arguments_are_the_parameters_that_the_node_declares() -> None:
    assert len(ABOUT) == len(launch.PARAMETERS) >= 17
    assert {"board", "prior.focal_px", "rectify_alpha", "queue_size"} <= ABOUT.keys()
    assert ABOUT.keys().isdisjoint(launch.SETUP)
    for about in ABOUT.values():
        assert about.description in launch.described(about)
    tree = ast.parse(LAUNCH.read_text())
    functions = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    assert "generate_launch_description" in functions
    # The rest of the file must load where launch is not installed, so that this test can.
    assert not [name for name in ("launch", "launch_ros") if hasattr(launch, name)]


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("prior.focal_px", "1200", 1200.0),
        ("prior.focal_px", "wide", "wide"),
        ("queue_size", "5", 5),
        ("queue_size", "5.5", "5.5"),
        ("auto_capture", "False", False),
        ("auto_capture", "maybe", "maybe"),
        ("camera_name", "17", "17"),
        ("board", "chessboard:9x6:0.025", "chessboard:9x6:0.025"),
    ],
)
def test_arguments_become_values_of_the_parameters_type(name: str, text: str, value) -> None:
    result = launch.parsed(ABOUT[name], text)
    assert (type(result), result) == (type(value), value)


def test_what_is_no_value_is_refused_by_the_node() -> None:
    with pytest.raises(InvalidInput, match="queue_size must be a whole number"):
        Parameters(board="chessboard:9x6:0.025", queue_size=launch.parsed(ABOUT["queue_size"], "5.5"))


@pytest.mark.parametrize("config", CONFIGS, ids=lambda path: path.stem)
def test_the_parameter_files_hold_parameters_of_the_node_with_values_it_takes(config: Path) -> None:
    values = parameters_of(config)
    assert values.keys() <= ABOUT.keys()
    settings = Parameters(board=values["board"]).changed(values)
    assert settings.camera_name == values["camera_name"]


def test_the_three_kinds_of_set_up_are_there_and_say_how_to_start_them() -> None:
    assert [path.stem for path in CONFIGS] == ["fixed_camera", "gige_compressed", "wrist_camera"]
    for config in CONFIGS:
        text = config.read_text()
        assert f"params_file:=$(ros2 pkg prefix --share fewcal)/config/{config.name}" in text
        for argument in ("image", "camera_info", "set_camera_info"):
            assert f"{argument}:=" not in text or argument in launch.SETUP


@pytest.mark.parametrize("config", CONFIGS, ids=lambda path: path.stem)
def test_the_node_starts_from_each_parameter_file(config: Path, tmp_path: Path) -> None:
    pytest.importorskip("rclpy")
    with own_domain() as environment:
        process = subprocess.Popen(
            [sys.executable, "-m", "fewcal_ros.node", "--ros-args", "--params-file", str(config)],
            env={**environment, "ROS_LOG_DIR": str(tmp_path)},
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            lines = []
            while "Waiting for images" not in "".join(lines[-1:]):
                lines.append(process.stderr.readline())
                assert lines[-1], lines
            process.send_signal(signal.SIGINT)
            _, err = process.communicate(timeout=TIMEOUT_S)
        finally:
            process.kill()
            process.wait()
    assert process.returncode == 0, err
    assert parameters_of(config)["board"] in lines[-1]
    if "compressed" in config.stem:
        assert "/image/compressed" in lines[-1]


def test_the_documentation_lists_every_parameter_as_it_is_declared() -> None:
    rows = {
        cells[0].strip("`"): cells
        for line in (ROOT / "doc" / "node.md").read_text().split("## Parameters")[1].splitlines()
        if line.startswith("| `")
        for cells in [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]]
    }
    assert rows.keys() == ABOUT.keys()
    kinds = {str: "string", bool: "bool", int: "integer", float: "double"}
    for name, about in ABOUT.items():
        _, kind, default, allowed, read_only, _ = rows[name]
        assert kind == kinds[type(about.default)], name
        shown = str(about.default).lower() if isinstance(about.default, bool) else about.default
        shown = f"{shown:g}" if isinstance(shown, float) else str(shown)
        assert default.strip("`") == shown, name
        least_to_largest = f"{about.bounds[0]:g} to {about.bounds[1]:g}" if about.bounds else ""
        assert allowed.replace("`", "") == (", ".join(about.choices) or least_to_largest), name
        assert read_only == ("yes" if about.read_only else "no"), name


def test_the_tutorial_shows_the_program_that_is_tested() -> None:
    program = (ROOT / "doc" / "examples" / "robot_program.py").read_text()
    tutorial = (ROOT / "doc" / "tutorial_wrist_camera.md").read_text()
    shown = tutorial.split("```python\n")[1].split("```")[0]
    assert shown in program
