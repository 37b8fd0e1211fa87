"""What /diagnostics says of the node, number by number."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scenes import SIZE, noisy, views_at

from fewcal.calibration import Calibration, calibrate
from fewcal.frame_filter import Decision
from fewcal_ros.health import Level, focal_text, health_values, judge_health
from fewcal_ros.messages import OTHER_CAMERA, Frame
from fewcal_ros.parameters import Parameters
from fewcal_ros.status import Look, Result, Status
from fewcal_ros.stream import ImageStream

PLANES = ((40, 30), (35, 120))


def found(seed: int = 1, method: str = "map") -> Calibration:
    return calibrate(noisy(views_at(*PLANES), 0.1, seed), SIZE, method)


def stream_of(*sizes: tuple[int, int]) -> ImageStream:
    """What is known of a stream of images of these sizes."""
    stream = ImageStream()
    for width, height in sizes:
        image = np.zeros((height, width), np.uint8)
        stream.note(SimpleNamespace(encoding="mono8"), Frame(image, None, "camera", "a test"))
    return stream


@pytest.fixture
def status() -> Status:
    """A calibrated node; every count is another one."""
    calibration = found()
    return Status(
        parameters=Parameters(board="chessboard:9x6:0.025"),
        views=calibration.views,
        estimate=calibration,
        result=Result(calibration, "camera"),
        complete=True,
        failure="",
        read=11,
        with_board=7,
        rejected=Counter({"no board": 4, "moving": 2}),
        received=17,
        dropped=5,
        unreadable=1,
        stream=ImageStream(),
        last=Look(None, decision=Decision(False, "no board", "No chessboard.")),
        last_took_s=0.0625,
        idle_s=0.1,
        silence="",
    )


def test_every_count_is_given_under_its_own_name(status: Status) -> None:
    values = dict(health_values(status))
    counts = {
        "images received": 17,
        "images dropped": 5,
        "images unreadable": 1,
        "images looked at": 11,
        "images with board": 7,
        "rejected: no board": 4,
        "rejected: moving": 2,
        "views": 2,
    }
    assert {name: int(values[name]) for name in counts} == counts
    assert values["last image took (s)"] == "0.062"
    assert values["last image"] == "No chessboard."
    assert (values["complete"], values["calibrated"], values["usable"]) == ("yes", "yes", "yes")
    assert dict(health_values(replace(status, complete=False)))["complete"] == "no"


def test_a_calibration_is_given_with_its_error_bars(status: Status) -> None:
    assert status.result is not None
    calibration, values = status.result.calibration, dict(health_values(status))
    assert calibration.std is not None
    assert float(values["fx"]) == calibration.camera.fx
    assert float(values["fx sd"]) == pytest.approx(calibration.std["fx"], rel=1e-5)
    assert float(values["rms (px)"]) == pytest.approx(calibration.rms, abs=1e-4)
    assert values["image size"] == "{}x{}".format(*SIZE)
    assert judge_health(status) == (Level.OK, f"Calibrated and usable: {focal_text(calibration)}.")


def test_before_the_first_view_there_is_little_to_tell(status: Status) -> None:
    before = replace(status, views=(), estimate=None, result=None, complete=False, last=Look(None))
    values = dict(health_values(before))
    assert values["calibrated"] == "no"
    assert values["last image"] == "not needed"
    assert not {"fx", "estimated f (px)", "rms (px)"} & set(values)
    level, sentence = judge_health(before)
    assert level is Level.WARN
    assert sentence == "0 of 2 views, the focal length is not known yet."
    assert dict(health_values(replace(before, last=None)))["last image"] == ""


def test_other_views_than_those_of_the_calibration_are_told_however_many_they_are(status: Status) -> None:
    level, sentence = judge_health(replace(status, views=found(2).views))
    assert level is Level.WARN
    assert sentence.startswith("The views have changed since the calibration. 2 views now, f = ")


def test_what_must_be_mended_first_is_what_is_said(status: Status) -> None:
    other = Look(None, decision=Decision(False, OTHER_CAMERA, "Another camera."))
    assert status.result is not None
    usable = status.result.calibration
    unusable = replace(
        usable, verdict=replace(usable.verdict, usable=False, reasons=("Too small.", "Too far."))
    )
    half = stream_of((320, 240))
    # Each thing that is wrong is added to those before, and is more urgent than they are.
    for change, said in (
        ({}, (Level.OK, "Calibrated and usable")),
        ({"result": Result(unusable, "camera")}, (Level.WARN, "Not usable: Too small. Too far.")),
        ({"views": usable.views[:1]}, (Level.WARN, "The views have changed since the calibration. 1 view")),
        ({"result": None}, (Level.WARN, "1 of 2 views, f = ")),
        ({"last": other}, (Level.WARN, "Another camera.")),
        ({"stream": half}, (Level.WARN, "The images are 320x240 now and the views {}x{}; ".format(*SIZE))),
        ({"failure": "Take others."}, (Level.ERROR, "Take others.")),
        ({"last": Look(None, problem="Unreadable.")}, (Level.ERROR, "Unreadable.")),
        ({"idle_s": 61.4, "silence": "Start it."}, (Level.WARN, "No image has arrived for 61 s. Start it.")),
        ({"idle_s": None}, (Level.WARN, "No image has arrived yet. Start it.")),
    ):  # fmt: skip
        status = replace(status, **change)
        level, sentence = judge_health(status)
        assert level is said[0]
        assert sentence.startswith(said[1])


def test_the_way_and_the_input_are_told(status: Status) -> None:
    values = dict(health_values(status))
    assert (values["mode"], values["input"], values["input changes"]) == ("automatic", "none", "0")
    assert "last input change" not in values
    manual = replace(status.parameters, auto_capture=False)
    stream = stream_of((640, 480), (320, 240))
    values = dict(health_values(replace(status, parameters=manual, stream=stream)))
    assert (values["mode"], values["input changes"]) == ("services", "1")
    assert "320x240" in values["input"]
    assert "320" in values["last input change"]
    stale = judge_health(replace(status, parameters=manual, views=()))[1]
    assert stale.startswith("The views have changed since the calibration; call ~/calibrate. 0 views now")


def test_the_focal_length_is_given_in_pixels_and_per_cent() -> None:
    calibration = found()
    assert calibration.focal_std is not None
    f, sd = calibration.camera.fx, calibration.focal_std
    assert focal_text(calibration) == f"f = {f:.1f} +- {sd * f:.1f} px ({100 * sd:.2g} %, one sigma)"
    assert focal_text(None) == "the focal length is not known yet"
    zhang = found(method="zhang")
    assert focal_text(zhang) == f"f = {zhang.camera.fx:.1f} px, without an error bar"
    unknown = replace(calibration, covariance=np.full((8, 8), np.inf))
    assert focal_text(unknown) == "the focal length is not determined yet"
