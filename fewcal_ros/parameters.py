"""The parameters of the node: each declared once, with its description, its range and its default."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from fewcal.boards import Board, KnownObject, parse_board
from fewcal.calibration import METHODS
from fewcal.camera_info import check_camera_name
from fewcal.constraints import Priors
from fewcal.errors import InvalidInput
from fewcal.frame_filter import Criteria
from fewcal.verdict import Thresholds

Value = str | bool | int | float

TRANSPORTS = ("raw", "compressed")
"""The image_transport transports that can be subscribed to."""


@dataclass(frozen=True)
class About:
    """What ROS is told about a parameter.

    Attributes
    ----------
    name : str
        With the dots that a field cannot have.
    default : str, bool, int or float
    description : str
    bounds : (least, largest) or None
    choices : tuple of str
        The values allowed; empty when any is.
    read_only : bool
        Structural: fixed when the node starts.
    """

    name: str
    default: Value
    description: str
    bounds: tuple[float, float] | None = None
    choices: tuple[str, ...] = ()
    read_only: bool = False

    def checked(self, value: Any) -> Any:
        """Check a value, taking a whole number for a real one.

        Raises
        ------
        InvalidInput
            When the value is of another type or out of range.
        """
        if isinstance(self.default, float) and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if type(value) is not type(self.default):
            kind = {str: "text", bool: "true or false", int: "a whole number", float: "a number"}
            hint = "; quote it, on a command line as '\"007\"'" if isinstance(self.default, str) else ""
            raise InvalidInput(f"{self.name} must be {kind[type(self.default)]}, not {value!r}{hint}.")
        number: Any = value
        if self.bounds is not None and not self.bounds[0] <= number <= self.bounds[1]:
            raise InvalidInput(
                f"{self.name} must be from {self.bounds[0]:g} to {self.bounds[1]:g}, not {value!r}."
            )
        if self.choices and value not in self.choices:
            raise InvalidInput(f"{self.name} must be one of {', '.join(self.choices)}, not {value!r}.")
        return value


def _parameter(name: str, default: Value, description: str, **more: Any) -> Any:
    return field(default=default, metadata={"about": About(name, default, description, **more)})


@dataclass(frozen=True)
class Parameters:
    """The parameters, checked; doc/node.md and `ros2 param describe fewcal` say what each is for.

    Raises
    ------
    InvalidInput
        When a value, or a combination of values, cannot be used.
    """

    board: str = _parameter(
        "board",
        "",
        "What is shown to the camera, such as chessboard:9x6:0.025 "
        "(interior corners; edge of a square in metres).",
        read_only=True,
    )
    views_required: int = _parameter(
        "views_required", 2, "Views that a calibration is made from.", bounds=(1, 100)
    )
    auto_capture: bool = _parameter(
        "auto_capture",
        True,
        "Take views and calibrate as they come; false leaves both to the services ~/capture and ~/calibrate.",
    )
    method: str = _parameter(
        "method", "map", "Estimator; zhang has no error bars, only map uses a prior.", choices=METHODS
    )
    prior_focal_px: float = _parameter(
        "prior.focal_px",
        0.0,
        "Focal length, pixels, when the lens is known; 0 when not.",
        bounds=(0.0, 1e6),
        read_only=True,
    )
    prior_focal_std_px: float = _parameter(
        "prior.focal_std_px",
        0.0,
        "One sigma of prior.focal_px, pixels.",
        bounds=(0.0, 1e6),
        read_only=True,
    )
    min_sharpness: float = _parameter(
        "min_sharpness",
        Criteria.min_sharpness,
        "Least inverse width of the edges of the board, 1/px: 0.5 is sharp, 0.125 means 8 px.",
        bounds=(0.0, 1.0),
    )
    max_motion_px: float = _parameter(
        "max_motion_px",
        Criteria.max_motion_px,
        "Farthest that a corner may move from one frame to the next, pixels.",
        bounds=(0.0, 1e4),
    )
    max_focal_std: float = _parameter(
        "max_focal_std",
        Thresholds.focal_std,
        "Relative error of the focal length (one sigma) up to which a camera is usable.",
        bounds=(1e-6, 1.0),
    )
    camera_name: str = _parameter(
        "camera_name", "camera", "Name in the saved file and hardware id: letters, digits and underscores."
    )
    output_path: str = _parameter(
        "output_path",
        "",
        "File that ~/save writes, or a folder, existing or ending in /, for CAMERA_NAME.yaml; "
        "empty: $ROS_HOME/camera_info/CAMERA_NAME.yaml, where ROS_HOME is ~/.ros unless set.",
    )
    frame_id: str = _parameter(
        "frame_id", "", "frame_id of the camera_info published; empty takes that of the image."
    )
    image_transport: str = _parameter(
        "image_transport",
        "raw",
        "raw: sensor_msgs/Image on image; compressed: sensor_msgs/CompressedImage on image/compressed.",
        choices=TRANSPORTS,
        read_only=True,
    )
    queue_size: int = _parameter(
        "queue_size",
        1,
        "Images that may wait to be looked at; when there are more, the oldest are dropped.",
        bounds=(1, 10_000),
        read_only=True,
    )
    publish_camera_info: bool = _parameter(
        "publish_camera_info",
        False,
        "Publish camera_info for every image, with its stamp and frame_id.",
        read_only=True,
    )
    publish_unusable: bool = _parameter(
        "publish_unusable",
        False,
        "Publish, save and commit a camera even when the verdict says that it is not usable.",
    )
    rectify_alpha: float = _parameter(
        "rectify_alpha",
        -1.0,
        "P of camera_info: negative for [K|0]; 0 (no invalid pixels) to 1 (all pixels kept) "
        "for cv2.getOptimalNewCameraMatrix.",
        bounds=(-1.0, 1.0),
    )

    def __post_init__(self) -> None:
        for name, about in _declared():
            object.__setattr__(self, name, about.checked(getattr(self, name)))
        if not self.board:
            raise InvalidInput(
                "The parameter board is missing; say what is shown, for example "
                "-p board:=chessboard:9x6:0.025 (interior corners, metres)."
            )
        if isinstance(parse_board(self.board), KnownObject):
            raise InvalidInput(
                f"{self.board} needs a file of pixels for every image, which live images do not have; "
                "use fewcal calibrate."
            )
        check_camera_name(self.camera_name)
        if re.search(r"://|\$|\0|^\s+$", self.output_path):
            raise InvalidInput(
                f"output_path is {self.output_path!r}, but a plain path is wanted, without scheme or "
                "variables; ~ is your home."
            )
        try:
            Path(self.output_path).expanduser()
        except RuntimeError:
            raise InvalidInput(
                f"There is no user whose home is meant by {self.output_path}; correct it."
            ) from None
        if (self.prior_focal_px > 0) != (self.prior_focal_std_px > 0):
            raise InvalidInput("prior.focal_px and prior.focal_std_px belong together; give both or neither.")
        if self.prior_focal_px > 0 and self.method != "map":
            raise InvalidInput(
                f"prior.focal_px is for the method map; {self.method} uses nothing known beforehand."
            )

    def changed(self, values: Mapping[str, Any]) -> Parameters:
        """The parameters with some values changed, by their ROS names; names that are unknown are left out.

        Raises
        ------
        InvalidInput
            When a value, or the combination, cannot be used.
        """
        known = {about.name: name for name, about in _declared()}
        return replace(self, **{known[name]: values[name] for name in values if name in known})

    @cached_property
    def target(self) -> Board:
        """The board, parsed."""
        return parse_board(self.board)

    @property
    def priors(self) -> Priors:
        """What is known of the camera beforehand."""
        known = self.prior_focal_px > 0
        return Priors(focal_px=(self.prior_focal_px, self.prior_focal_std_px) if known else None)

    @property
    def thresholds(self) -> Thresholds:
        """Where usable ends."""
        return Thresholds(focal_std=self.max_focal_std)

    @property
    def criteria(self) -> Criteria:
        """When a view is worth keeping."""
        return Criteria(min_sharpness=self.min_sharpness, max_motion_px=self.max_motion_px)

    @property
    def save_path(self) -> Path:
        """The file that ~/save writes."""
        name = f"{self.camera_name}.yaml"
        if self.output_path:
            path = Path(self.output_path).expanduser()
            return path / name if path.is_dir() or self.output_path.endswith("/") else path
        home = os.environ.get("ROS_HOME")
        return (Path(home) if home else Path.home() / ".ros") / "camera_info" / name


def _declared() -> Iterator[tuple[str, About]]:
    for item in fields(Parameters):
        yield item.name, item.metadata["about"]


def declare_parameters(node: Any) -> Parameters:
    """Declare every parameter on a node and read its value.

    Parameters
    ----------
    node : rclpy.node.Node

    Raises
    ------
    InvalidInput
        When a value given at the start cannot be used.
    """
    # Only here, so that the checks above work where no ROS is.
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, ParameterType

    kinds = {
        str: ParameterType.PARAMETER_STRING,
        bool: ParameterType.PARAMETER_BOOL,
        int: ParameterType.PARAMETER_INTEGER,
        # 2 for 2.0 is what everybody writes; typed statically, ROS would refuse it.
        float: ParameterType.PARAMETER_NOT_SET,
    }
    values: dict[str, Any] = {}
    for name, about in _declared():
        # Any type at first: what is wrong with a value given at the start is said in our own words.
        anything = ParameterDescriptor(dynamic_typing=True)
        values[name] = about.checked(node.declare_parameter(about.name, about.default, anything).value)
        descriptor = ParameterDescriptor(description=about.description, read_only=about.read_only)
        descriptor.type = kinds[type(about.default)]
        descriptor.dynamic_typing = descriptor.type == ParameterType.PARAMETER_NOT_SET
        if about.choices:
            descriptor.additional_constraints = f"One of {', '.join(about.choices)}."
        if about.bounds is not None:
            least, largest = about.bounds
            if isinstance(about.default, float):
                descriptor.floating_point_range = [FloatingPointRange(from_value=least, to_value=largest)]
            else:
                descriptor.integer_range = [IntegerRange(from_value=int(least), to_value=int(largest))]
        node.set_descriptor(about.name, descriptor)
    return Parameters(**values)


def warn_of_unknown(node: Any) -> None:
    """Name the parameters that were given and that nobody reads: one may be misspelt, or another node's.

    Parameters
    ----------
    node : rclpy.node.Node
        With all its parameters declared, and all overrides of QoS.
    """
    # rclpy has no public way to ask for what was given but not declared.
    given = getattr(node, "_parameter_overrides", {})
    known = {about.name for _, about in _declared()}
    for name in sorted(set(given) - known):
        if not node.has_parameter(name):
            near = difflib.get_close_matches(name, known | set(node.list_parameters([], 0).names), 1)
            hint = f"; did you mean {near[0]}?" if near else "."
            node.get_logger().warning(f"There is no parameter {name}{hint}")
