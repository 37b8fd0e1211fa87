"""What the node publishes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import CAMERA, SIZE, views_at

import fewcal
from fewcal.errors import InvalidInput

pytest.importorskip("sensor_msgs")
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus

from fewcal_ros.health import Level
from fewcal_ros.outgoing import (
    camera_info_message,
    camera_info_of,
    diagnostics_message,
    header_of,
    image_message,
)

FOLDED = fewcal.Camera(600, 600, 320, 240, [-2.3, 0.3, -0.1, 0, 0])


def test_a_rectified_image_has_a_projection() -> None:
    calibration = fewcal.calibrate(views_at((40, 0), (40, 90)), SIZE)
    plain, cropped, whole = (camera_info_of(calibration, "wrist", alpha) for alpha in (-1, 0, 1))
    np.testing.assert_array_equal(plain.projection[:, :3], calibration.camera.matrix)
    # With barrel distortion the whole image is more than the rectangle that is filled.
    assert whole.projection[0, 0] < cropped.projection[0, 0]
    assert cropped.projection[0, 0] == pytest.approx(CAMERA.fx, rel=0.2)


def test_a_camera_without_a_rectified_image_has_none_published() -> None:
    """OpenCV gives such a P a negative focal length."""
    calibration = replace(
        fewcal.calibrate(views_at((40, 0), (40, 90)), SIZE), camera=FOLDED, image_size=(640, 480)
    )
    with pytest.raises(InvalidInput, match="set rectify_alpha to -1"):
        camera_info_of(calibration, "wrist", 0.0)
    assert camera_info_of(calibration, "wrist", -1.0).projection[0, 0] == FOLDED.fx


def test_a_camera_info_message_says_what_the_camera_info_does() -> None:
    info = camera_info_of(fewcal.calibrate(views_at((40, 0), (40, 90)), SIZE), "wrist", 0.0)
    message = camera_info_message(info, header_of(12_000_000_345, "optical"))
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (12, 345)
    assert message.header.frame_id == "optical"
    assert (message.width, message.height, message.distortion_model) == (*SIZE, "plumb_bob")
    np.testing.assert_array_equal(message.d, info.camera.distortion)
    np.testing.assert_array_equal(np.reshape(message.k, (3, 3)), info.camera.matrix)
    np.testing.assert_array_equal(np.reshape(message.r, (3, 3)), np.eye(3))
    np.testing.assert_array_equal(np.reshape(message.p, (3, 4)), info.projection)


def test_a_picture_is_sent_row_by_row() -> None:
    picture = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)
    message = image_message(picture[:, ::-1], header_of(0, "optical"))
    assert (message.height, message.width, message.step) == (2, 3, 9)
    assert (message.encoding, message.is_bigendian) == ("bgr8", 0)
    np.testing.assert_array_equal(np.reshape(message.data, (2, 3, 3)), picture[:, ::-1])


@pytest.mark.parametrize("level", Level)
def test_diagnostics_are_one_status(level: Level) -> None:
    message = diagnostics_message(Time(sec=7), "fewcal", "wrist", level, "Well.", [("fx", "1"), ("fy", "2")])
    (status,) = message.status
    assert message.header.stamp.sec == 7
    assert status.level == getattr(DiagnosticStatus, level.name)
    assert (status.name, status.hardware_id, status.message) == ("fewcal", "wrist", "Well.")
    assert [(value.key, value.value) for value in status.values] == [("fx", "1"), ("fy", "2")]
