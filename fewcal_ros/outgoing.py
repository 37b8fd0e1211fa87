"""What the node publishes, as messages: CameraInfo, annotated images and diagnostics."""

from __future__ import annotations

import array
from collections.abc import Iterable

import cv2
import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo as CameraInfoMessage
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from fewcal.calibration import Calibration
from fewcal.camera_info import CameraInfo
from fewcal.errors import InvalidInput

from .health import Level


def camera_info_of(calibration: Calibration, camera_name: str, rectify_alpha: float) -> CameraInfo:
    """The content of a camera_info, from which the file and the message are made alike.

    Parameters
    ----------
    calibration : Calibration
    camera_name : str
    rectify_alpha : float
        From 0 to 1 for the P of cv2.getOptimalNewCameraMatrix; negative for P = [K | 0].

    Raises
    ------
    InvalidInput
        When the distortion leaves no rectified image.
    """
    camera, size = calibration.camera, calibration.image_size
    projection = None
    if rectify_alpha >= 0:
        matrix, _ = cv2.getOptimalNewCameraMatrix(camera.matrix, camera.distortion, size, rectify_alpha)
        if not (matrix[0, 0] > 0 and matrix[1, 1] > 0):
            raise InvalidInput(
                "The distortion folds the image, so that there is no rectified one; set rectify_alpha to -1, "
                "or take views that make a usable camera."
            )
        projection = np.pad(matrix, ((0, 0), (0, 1)))
    return CameraInfo(camera, size, camera_name, projection=projection)


def camera_info_message(info: CameraInfo, header: Header) -> CameraInfoMessage:
    """sensor_msgs/CameraInfo of a camera_info."""
    width, height = info.image_size
    return CameraInfoMessage(
        header=header,
        width=width,
        height=height,
        distortion_model=info.camera.model,
        d=info.camera.distortion.tolist(),
        k=info.camera.matrix.ravel().tolist(),
        r=info.rectification.ravel().tolist(),
        p=info.projection.ravel().tolist(),
    )


def header_of(stamp_ns: int, frame_id: str) -> Header:
    """std_msgs/Header."""
    seconds, rest = divmod(stamp_ns, 1_000_000_000)
    return Header(stamp=Time(sec=seconds, nanosec=rest), frame_id=frame_id)


def image_message(picture: NDArray[np.uint8], header: Header) -> Image:
    """sensor_msgs/Image of a (H, W, 3) BGR picture."""
    height, width = picture.shape[:2]
    # Any other sequence would be checked byte by byte.
    data = array.array("B", np.ascontiguousarray(picture).tobytes())
    return Image(
        header=header,
        height=height,
        width=width,
        encoding="bgr8",
        is_bigendian=0,
        step=3 * width,
        data=data,
    )


_LEVELS = {
    Level.OK: DiagnosticStatus.OK,
    Level.WARN: DiagnosticStatus.WARN,
    Level.ERROR: DiagnosticStatus.ERROR,
}


def diagnostics_message(
    stamp: Time, name: str, hardware_id: str, level: Level, message: str, values: Iterable[tuple[str, str]]
) -> DiagnosticArray:
    """diagnostic_msgs/DiagnosticArray with one status."""
    status = DiagnosticStatus(
        level=_LEVELS[level],
        name=name,
        message=message,
        hardware_id=hardware_id,
        values=[KeyValue(key=key, value=value) for key, value in values],
    )
    return DiagnosticArray(header=Header(stamp=stamp), status=[status])
