from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from ros_domain import own_domain

from fewcal.constraints import Priors
from fewcal.errors import InvalidInput
from fewcal.frame_filter import Criteria
from fewcal.verdict import Thresholds
from fewcal_ros.parameters import About, Parameters

BOARD = "chessboard:9x6:0.025"
DESCRIBE = """
import json
import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter
from fewcal_ros.parameters import Parameters, declare_parameters

rclpy.init()
node = Node("described", parameter_overrides=[Parameter("board", value="chessboard:9x6:0.025")])
assert declare_parameters(node) == Parameters(board="chessboard:9x6:0.025")
told = {}
for name in node.list_parameters([], 0).names:
    about = node.describe_parameter(name)
    ranges = [*about.floating_point_range, *about.integer_range]
    told[name] = {
        "type": about.type, "dynamic_typing": about.dynamic_typing, "read_only": about.read_only,
        "description": about.description, "constraints": about.additional_constraints,
        "ranges": [(type(each).__name__, each.from_value, each.to_value) for each in ranges],
    }
def accepted(name, value):
    return node.set_parameters([Parameter(name, value=value)])[0].successful
told["accepted"] = [
    accepted(*each)
    for each in (("views_required", 3), ("max_motion_px", 3), ("max_motion_px", 2.5), ("views_required", 0),
                 ("views_required", 2.5), ("max_motion_px", -0.5), ("image_transport", "compressed"))
]
print(json.dumps(told))
rclpy.shutdown()
"""


def test_the_defaults_are_those_of_the_library():
    parameters = Parameters(board=BOARD)
    assert parameters.criteria == Criteria()
    assert parameters.thresholds == Thresholds()
    assert parameters.priors == Priors()
    assert str(parameters.target) == BOARD


def test_every_parameter_is_described():
    for field in Parameters.__dataclass_fields__.values():
        about: About = field.metadata["about"]
        assert about.name.replace(".", "_") == field.name
        assert about.description.endswith(".")
        assert about.bounds is not None or type(about.default) in (str, bool)


@pytest.fixture(scope="module")
def described() -> Any:
    """What a node in a process of its own says of its parameters, and which changes it takes."""
    pytest.importorskip("rclpy")
    with own_domain() as environment:
        done = subprocess.run(
            [sys.executable, "-c", DESCRIBE], env=environment, capture_output=True, text=True, timeout=60
        )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_ros_is_told_what_each_parameter_takes(described: Any) -> None:
    types = {bool: 1, int: 2, float: 3, str: 4}  # of rcl_interfaces/ParameterType
    for field in Parameters.__dataclass_fields__.values():
        about: About = field.metadata["about"]
        told = described[about.name]
        assert (told["type"], told["read_only"]) == (types[type(about.default)], about.read_only)
        assert told["dynamic_typing"] == (type(about.default) is float)
        assert told["description"] == about.description
        assert all(choice in told["constraints"] for choice in about.choices)
        assert bool(told["constraints"]) == bool(about.choices)
        kind = "FloatingPointRange" if type(about.default) is float else "IntegerRange"
        assert told["ranges"] == ([[kind, *about.bounds]] if about.bounds else [])


def test_ros_itself_refuses_what_is_out_of_range_or_fixed(described: Any) -> None:
    assert described["accepted"] == [True, True, True, False, False, False, False]


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"views_required": 0}, "views_required must be from 1 to 100, not 0."),
        ({"views_required": 2.0}, "views_required must be a whole number, not 2.0."),
        ({"views_required": True}, "views_required must be a whole number"),
        ({"auto_capture": 1}, "auto_capture must be true or false, not 1."),
        ({"max_motion_px": float("nan")}, "max_motion_px must be from 0 to 10000, not nan."),
        ({"max_motion_px": None}, "max_motion_px must be a number, not None."),
        ({"max_motion_px": True}, "max_motion_px must be a number"),
        ({"method": "best"}, "method must be one of map, zhu2020, zhang, not 'best'."),
        ({"image_transport": "theora"}, "image_transport must be one of raw, compressed"),
        ({"camera_name": "a b"}, "letters, digits and underscores"),
        ({"prior.focal_px": 500.0}, "belong together"),
        (
            {"prior.focal_px": 500.0, "prior.focal_std_px": 5.0, "method": "zhu2020"},
            "prior.focal_px is for the method map; zhu2020 uses nothing known beforehand.",
        ),
        ({"board": ""}, "The parameter board is missing"),
        ({"board": "chessboard:2x6:0.1"}, "at least 3"),
    ],
)
def test_what_cannot_be_used_is_refused_with_a_reason(values, reason):
    with pytest.raises(InvalidInput) as caught:
        Parameters(board=BOARD).changed(values)
    assert reason in str(caught.value)


def test_a_whole_number_serves_for_a_real_one():
    parameters = Parameters(board=BOARD).changed({"max_motion_px": 3, "use_sim_time": True})
    assert type(parameters.max_motion_px) is float
    assert parameters.criteria.max_motion_px == 3


def test_the_prior_is_taken_over():
    parameters = Parameters(board=BOARD).changed({"prior.focal_px": 500, "prior.focal_std_px": 5})
    assert parameters.priors == Priors(focal_px=(500.0, 5.0))


def test_where_the_file_goes(tmp_path, monkeypatch):
    parameters = Parameters(board=BOARD, camera_name="wrist")
    monkeypatch.delenv("ROS_HOME", raising=False)
    monkeypatch.setenv("HOME", "/home/somebody")
    assert parameters.save_path == Path("/home/somebody/.ros/camera_info/wrist.yaml")
    monkeypatch.setenv("ROS_HOME", "/ros")
    assert parameters.save_path == Path("/ros/camera_info/wrist.yaml")
    for given, expected in (
        (str(tmp_path), tmp_path / "wrist.yaml"),
        ("/new/folder/", Path("/new/folder/wrist.yaml")),
        ("/new/file.yaml", Path("/new/file.yaml")),
        ("~/file.yaml", Path("/home/somebody/file.yaml")),
    ):
        assert parameters.changed({"output_path": given}).save_path == expected


@pytest.mark.parametrize(
    "path", ["file:///tmp/x.yaml", "package://cell/x.yaml", "$HOME/x.yaml", "a\0b", "  "]
)
def test_the_file_is_a_plain_path(path):
    with pytest.raises(InvalidInput, match="a plain path is wanted, without scheme or variables"):
        Parameters(board=BOARD, output_path=path)
