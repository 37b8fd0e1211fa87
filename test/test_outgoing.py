"""What the node publishes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import CAMERA, SIZE, views_at

import fewcal
from fewcal.errors import InvalidInput

pytest.importorskip("sensor_msgs")
from fewcal_ros.outgoing import camera_info_of

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
