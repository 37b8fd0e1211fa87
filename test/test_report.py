"""A calibration in words and as JSON."""

from __future__ import annotations

import json
import math
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from board_pictures import BOARD, CAMERA, SIZE, pose

from fewcal.calibration import METHODS, Calibration, calibrate
from fewcal.verdict import Verdict
from fewcal.views import View
from fewcal_ros.offline import Outcome
from fewcal_ros.report import as_json, as_text


def outcome(method: str = "map", **changes: Any) -> Outcome:
    """Two exact views in four frames."""
    poses = pose(BOARD, 34.0, 40.0, 10.0), pose(BOARD, 34.0, 40.0, 100.0)
    noise = np.random.default_rng(1).normal(0, 0.1, (2, len(BOARD.points), 2))
    views = [
        View(BOARD.points, CAMERA.project(BOARD.points, T) + offset, source=name, stamp_ns=stamp)
        for T, offset, name, stamp in zip(poses, noise, ("a.png", "run:/b@1.5"), (None, 15), strict=True)
    ]
    calibration = replace(calibrate(views, SIZE, method), **changes)
    return Outcome(calibration, 4, 3, Counter({"no board": 1, "blurred": 1}))


def parsed(result: Outcome) -> Any:
    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is not JSON")

    text = as_json(result)
    assert text.endswith("}\n")
    return json.loads(text, parse_constant=refuse)


def check_schema(content: Any) -> None:
    """Check the keys, their order and types against the documentation of the command."""
    keys = ["image_size", "camera", "std", "focal_std", "rms_px", "views", "verdict", "frames"]
    assert list(content) == keys
    assert [type(side) for side in content["image_size"]] == [int, int]
    camera = content["camera"]
    assert list(camera) == ["model", "fx", "fy", "cx", "cy", "distortion"]
    assert camera["model"] == "plumb_bob"
    assert len(camera["distortion"]) == 5
    values = [camera[name] for name in ("fx", "fy", "cx", "cy")] + camera["distortion"]
    assert all(type(value) is float and math.isfinite(value) for value in [*values, content["rms_px"]])
    if content["std"] is not None:
        assert list(content["std"]) == ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"]
        assert all(value is None or value > 0 for value in content["std"].values())
    assert content["focal_std"] is None or content["focal_std"] > 0
    for view in content["views"]:
        assert list(view) == ["source", "stamp_ns", "points", "rms_px", "tilt_deg", "T_camera_board"]
        assert type(view["source"]) is str
        assert view["stamp_ns"] is None or type(view["stamp_ns"]) is int
        assert type(view["points"]) is int
        assert type(view["rms_px"]) is float
        assert 0 <= view["tilt_deg"] <= 90
        T = np.array(view["T_camera_board"], dtype=float)
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
        np.testing.assert_array_equal(T[3], [0, 0, 0, 1])
    assert list(content["verdict"]) == ["usable", "reasons"]
    assert type(content["verdict"]["usable"]) is bool
    assert all(type(reason) is str for reason in content["verdict"]["reasons"])
    frames = content["frames"]
    assert list(frames) == ["read", "with_board", "rejected"]
    assert all(type(count) is int and count > 0 for count in frames["rejected"].values())
    assert frames["read"] == len(content["views"]) + sum(frames["rejected"].values())


@pytest.mark.parametrize("method", METHODS)
def test_json_is_as_documented(method: str) -> None:
    result = outcome(method)
    content = parsed(result)
    check_schema(content)
    calibration = result.calibration
    assert content["camera"]["fx"] == calibration.camera.fx  # bit by bit
    assert content["camera"]["distortion"] == calibration.camera.distortion.tolist()
    assert content["std"] == calibration.std
    assert [view["stamp_ns"] for view in content["views"]] == [None, 15]
    np.testing.assert_array_equal(content["views"][1]["T_camera_board"], calibration.board_poses[1])
    assert content["verdict"]["reasons"] == list(calibration.verdict.reasons)
    assert content["frames"] == {"read": 4, "with_board": 3, "rejected": {"blurred": 1, "no board": 1}}
    if method == "zhang":
        assert content["std"] is None
        assert content["focal_std"] is None


def test_what_is_not_finite_is_null() -> None:
    content = parsed(outcome(covariance=np.full((8, 8), np.inf), view_rms=np.array([np.nan, 1.0])))
    assert content["focal_std"] is None
    assert set(content["std"].values()) == {None}
    assert [view["rms_px"] for view in content["views"]] == [None, 1.0]


def test_text_tells_the_same() -> None:
    result = outcome()
    text = as_text(result)
    camera, std = result.calibration.camera, result.calibration.std
    assert std is not None
    assert "Camera 640x480, plumb_bob, from 2 of 4 frames (map)" in text
    assert f"{camera.fx:.2f} px +- {std['fx']:.2f}" in text
    assert f"{camera.distortion[0]:.5f}    +- {std['k1']:.5f}" in text
    assert "view run:/b@1.5: tilt 40 deg" in text
    assert "Frames not used: no board 1, blurred 1" in text
    assert text.endswith("\nUsable.\n")
    assert not [line for line in text.splitlines() if line != line.rstrip()]


def test_text_gives_the_reasons() -> None:
    text = as_text(outcome(verdict=Verdict(False, ("Too flat; tilt it.", "Too small; come nearer."))))
    assert text.endswith("\nNOT usable:\n  - Too flat; tilt it.\n  - Too small; come nearer.\n")


def test_text_without_error_bars() -> None:
    unknown: Calibration = outcome("zhang").calibration
    text = as_text(Outcome(unknown, 2, 2, Counter()))
    assert "+-" not in text
    assert "one sigma" not in text
    assert "Frames not used" not in text
    assert "inf" not in as_text(outcome(covariance=np.full((8, 8), np.inf)))
