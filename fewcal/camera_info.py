"""The ROS camera_info YAML, read and written.

The keys and their order are those of camera_calibration_parsers, so that camera_info_manager and every driver
on top of it load the file as it is. The text is read at the level of YAML nodes, where a scalar is still what
was written: ``1e3`` is a number although YAML 1.1 calls it a string, and a camera named ``0123`` keeps its
zero.
"""

from __future__ import annotations

import math
import os
import re
import reprlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import yaml
from numpy.typing import ArrayLike

from .camera import Array, Camera
from .checks import checked_size, real_array, require_kind
from .errors import InvalidInput
from .files import path_text, write_atomically

MAX_BYTES = 64 * 1024
"""Largest file read, bytes. A camera_info file has about 800; what is much larger is something else."""

_NAME = re.compile(r"[A-Za-z0-9_]+")
"""What camera_info_manager accepts as a camera name."""
_UNNAMED = "unknown"
"""What camera_calibration_parsers calls a camera whose file has no name."""
_NUMBER = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?")
_COUNT = re.compile(r"[0-9]{1,10}")

_Entries = dict[str, yaml.Node]


class HasCamera(Protocol):
    """What a camera_info is made from, such as a Calibration."""

    @property
    def camera(self) -> Camera:
        """The calibrated camera."""

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of the images it was calibrated for, pixels."""


@dataclass(frozen=True, eq=False)
class CameraInfo:
    """The content of a camera_info file (sensor_msgs/CameraInfo without its header).

    Parameters
    ----------
    camera : Camera
        K and D of sensor_msgs/CameraInfo.
    image_size : (int, int)
        Width and height, pixels.
    camera_name : str
        Any in a file; camera_info_manager accepts letters, digits and underscores alone from a driver.
    rectification : array_like, (3, 3), optional
        R: rotation into the rectified camera; the identity for a single camera, which is the default.
    projection : array_like, (3, 4), optional
        P, pixels: the projection of rectified images; [K | 0] when left out.

    Raises
    ------
    InvalidInput
        When a size is not positive and whole, or an array of another shape or not finite.
    """

    camera: Camera
    image_size: tuple[int, int]
    camera_name: str
    rectification: Array
    projection: Array

    def __init__(
        self,
        camera: Camera,
        image_size: tuple[int, int],
        camera_name: str,
        rectification: ArrayLike | None = None,
        projection: ArrayLike | None = None,
    ) -> None:
        require_kind("camera", camera, Camera)
        if not isinstance(camera_name, str):
            raise InvalidInput(f"camera_name must be a text, not {camera_name!r}.")
        R = np.eye(3) if rectification is None else real_array(rectification, "rectification")
        P = np.eye(3, 4) if projection is None else real_array(projection, "projection")
        if projection is None:
            P[:, :3] = camera.matrix
        if R.shape != (3, 3) or P.shape != (3, 4) or not (np.isfinite(R).all() and np.isfinite(P).all()):
            raise InvalidInput("rectification must be (3, 3) and projection (3, 4), of finite numbers.")
        R.setflags(write=False)
        P.setflags(write=False)
        for name, value in (
            ("camera", camera),
            ("image_size", checked_size(image_size)),
            ("camera_name", camera_name),
            ("rectification", R),
            ("projection", P),
        ):
            object.__setattr__(self, name, value)

    def __reduce__(self) -> tuple[type[CameraInfo], tuple[object, ...]]:
        # Through the constructor: numpy forgets that an array was read-only.
        return CameraInfo, (
            self.camera,
            self.image_size,
            self.camera_name,
            self.rectification,
            self.projection,
        )


def write_camera_info(
    path: str | os.PathLike[str], calibration: HasCamera, camera_name: str | None = None
) -> None:
    """Write a calibration as a camera_info file, whole or not at all.

    R is the identity and P = [K | 0], except for a CameraInfo, which has its own. Numbers are written so that
    they read back bit by bit.

    Parameters
    ----------
    path : str or path
        The file, commonly NAME.yaml.
    calibration : Calibration or CameraInfo
        Anything with a ``camera`` and an ``image_size``.
    camera_name : str, optional
        Letters, digits and underscores; camera_info_manager compares it with the driver's. When left out, it
        is that of a CameraInfo, or "camera".

    Raises
    ------
    InvalidInput
        When the name is not allowed or the file cannot be written.
    """
    if not isinstance(getattr(calibration, "camera", None), Camera):
        raise InvalidInput(f"calibration must be a fewcal.Calibration, not {reprlib.repr(calibration)}.")
    info = calibration
    if not isinstance(info, CameraInfo):
        info = CameraInfo(calibration.camera, calibration.image_size, "camera")
    if camera_name is not None:
        info = replace(info, camera_name=camera_name)
    check_camera_name(info.camera_name)
    write_atomically(path, camera_info_text(info))


def read_camera_info(path: str | os.PathLike[str]) -> CameraInfo:
    """Read a camera_info file.

    Parameters
    ----------
    path : str or path
        A file as camera_calibration_parsers, cameracalibrator or :func:`write_camera_info` write it.

    Raises
    ------
    InvalidInput
        When the file cannot be read or is no camera_info of a plumb_bob camera; names the file and the key.
    """
    name = path_text(path) or "''"
    try:
        return parse_camera_info(_read_text(Path(path)))
    except InvalidInput as error:
        raise InvalidInput(f"{name}: {error}") from None
    except (OSError, ValueError) as error:  # ValueError: a path that holds a NUL
        reason = getattr(error, "strerror", None) or error
        raise InvalidInput(f"{name!r} cannot be read: {reason}.") from None


def camera_info_text(info: CameraInfo) -> str:
    """YAML of a camera_info: the keys of camera_calibration_parsers in their order, full double precision."""
    width, height = info.image_size
    content: dict[str, Any] = {
        "image_width": width,
        "image_height": height,
        "camera_name": info.camera_name,
        "camera_matrix": _matrix(info.camera.matrix),
        "distortion_model": info.camera.model,
        "distortion_coefficients": _matrix(info.camera.distortion[None]),
        "rectification_matrix": _matrix(info.rectification),
        "projection_matrix": _matrix(info.projection),
    }
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=math.inf)


def parse_camera_info(text: str) -> CameraInfo:
    """Read the text of a camera_info file; :func:`camera_info_text` gives it back.

    Parameters
    ----------
    text : str
        YAML. Four distortion coefficients are taken as k1 k2 p1 p2 with k3 = 0; unknown keys are ignored. As
        camera_calibration_parsers has it, a file without a distortion_model is of plumb_bob, and one without
        a camera_name of "unknown".

    Raises
    ------
    InvalidInput
        When the text is no camera_info of a plumb_bob camera; names the key.
    """
    if text.startswith("%YAML:"):
        raise InvalidInput(
            "this is a file of OpenCV's FileStorage; a camera_info is what ROS reads and writes."
        )
    entries = _entries(_compose(text), "this")
    size = (_count(entries, "image_width"), _count(entries, "image_height"))
    name = _scalar(entries, "camera_name", default=_UNNAMED)
    K = _numbers(entries, "camera_matrix", (3, 3))
    if not (
        K[0, 0] > 0 and K[1, 1] > 0 and np.array_equal(K[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], [0, 0, 0, 0, 1])
    ):
        raise InvalidInput("camera_matrix must be [fx, 0, cx, 0, fy, cy, 0, 0, 1] with fx and fy above zero.")
    model = _scalar(entries, "distortion_model", default=Camera.model)
    if model != Camera.model:
        raise InvalidInput(f"distortion_model is {_short(model)}, but fewcal knows {Camera.model} only.")
    distortion = _numbers(entries, "distortion_coefficients", (1, 5), (5, 1), (1, 4), (4, 1)).ravel()
    camera = Camera(K[0, 0], K[1, 1], K[0, 2], K[1, 2], np.pad(distortion, (0, 5 - len(distortion))))
    rectification = _numbers(entries, "rectification_matrix", (3, 3))
    projection = _numbers(entries, "projection_matrix", (3, 4))
    return CameraInfo(camera, size, name, rectification, projection)


def check_camera_name(name: str) -> None:
    """Refuse a name that camera_info_manager would refuse.

    Raises
    ------
    InvalidInput
        When there is anything but letters, digits and underscores in it.
    """
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise InvalidInput(
            f"camera_name must be of letters, digits and underscores only, unlike {_short(str(name))}."
        )


def _matrix(values: Array) -> dict[str, Any]:
    rows, columns = values.shape
    return {"rows": rows, "cols": columns, "data": values.ravel().tolist()}


def _read_text(path: Path) -> str:
    if path.exists() and not path.is_file():  # a pipe would make the reader wait for ever
        raise InvalidInput("this is not a file.")
    with path.open("rb") as stream:
        data = stream.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise InvalidInput(f"this is no camera_info: it is larger than {MAX_BYTES // 1024} kB.")
    try:
        return data.decode()
    except UnicodeDecodeError:
        raise InvalidInput("this is no camera_info: it is not text.") from None


def _compose(text: str) -> yaml.Node | None:
    try:
        return yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.MarkedYAMLError as error:
        line = f" in line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise InvalidInput(f"this is not YAML{line}: {error.problem:.80}.") from None
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError):
        # The others come from escapes and directives beyond any limit, and from brackets nested too deep.
        raise InvalidInput("this is not YAML that can be read.") from None


def _entries(node: yaml.Node | None, name: str) -> _Entries:
    if not isinstance(node, yaml.MappingNode):
        raise InvalidInput(f"{name} is no mapping of keys to values, as a camera_info is.")
    entries: _Entries = {}
    for key, value in node.value:
        if isinstance(key, yaml.ScalarNode):
            if key.value in entries:
                raise InvalidInput(f"{_short(key.value)} stands in {name} twice.")
            entries[key.value] = value
    return entries


def _get(entries: _Entries, key: str, inside: str = "") -> yaml.Node:
    if key not in entries:
        raise InvalidInput(f"{inside}{key} is missing.")
    return entries[key]


def _scalar(entries: _Entries, key: str, inside: str = "", default: str | None = None) -> str:
    if default is not None and key not in entries:
        return default
    node = _get(entries, key, inside)
    if not isinstance(node, yaml.ScalarNode):
        raise InvalidInput(f"{inside}{key} must be a single value.")
    return str(node.value)


def _count(entries: _Entries, key: str, inside: str = "") -> int:
    text = _scalar(entries, key, inside)
    if _COUNT.fullmatch(text) is None or int(text) == 0:
        raise InvalidInput(f"{inside}{key} must be a whole number above zero, not {_short(text)}.")
    return int(text)


def _numbers(entries: _Entries, key: str, *shapes: tuple[int, int]) -> Array:
    inner, inside = _entries(_get(entries, key), key), f"{key}: "
    shape = _count(inner, "rows", inside), _count(inner, "cols", inside)
    if shape not in shapes:
        raise InvalidInput(f"{key} must be {shapes[0][0]} x {shapes[0][1]}, not {shape[0]} x {shape[1]}.")
    node = _get(inner, "data", inside)
    if not isinstance(node, yaml.SequenceNode) or len(node.value) != shape[0] * shape[1]:
        raise InvalidInput(f"{inside}data must be a list of {shape[0] * shape[1]} numbers.")
    return np.array([_number(item, inside) for item in node.value]).reshape(shape)


def _number(node: yaml.Node, inside: str) -> float:
    text = str(node.value) if isinstance(node, yaml.ScalarNode) else ""
    if _NUMBER.fullmatch(text) is None or not math.isfinite(value := float(text)):
        raise InvalidInput(f"{inside}data must hold finite numbers only, unlike {_short(text)}.")
    return value


def _short(text: str) -> str:
    return repr(text if len(text) <= 40 else text[:37] + "...")
