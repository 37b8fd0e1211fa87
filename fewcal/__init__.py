"""fewcal: camera calibration from one or two views of a board, with error bars that are true."""

from .boards import (
    AprilGrid,
    AsymmetricCircleGrid,
    Board,
    Charuco,
    Chessboard,
    CircleGrid,
    KnownObject,
    parse_board,
    pose_ambiguity,
)
from .calibration import Calibration, calibrate
from .camera import Camera
from .camera_info import CameraInfo, read_camera_info, write_camera_info
from .constraints import Normal, Priors, StudentT
from .detection import detect
from .errors import (
    BoardNotFound,
    DegenerateViews,
    FewcalError,
    ImaginaryFocalLength,
    InvalidInput,
    ModelFoldsOver,
)
from .frame_filter import Criteria
from .radial_prior import RadialPrior
from .session import Session
from .verdict import Thresholds, Verdict
from .views import View

__all__ = [
    "AprilGrid",
    "AsymmetricCircleGrid",
    "Board",
    "BoardNotFound",
    "Calibration",
    "Camera",
    "CameraInfo",
    "Charuco",
    "Chessboard",
    "CircleGrid",
    "Criteria",
    "DegenerateViews",
    "FewcalError",
    "ImaginaryFocalLength",
    "InvalidInput",
    "KnownObject",
    "ModelFoldsOver",
    "Normal",
    "Priors",
    "RadialPrior",
    "Session",
    "StudentT",
    "Thresholds",
    "Verdict",
    "View",
    "calibrate",
    "detect",
    "parse_board",
    "pose_ambiguity",
    "read_camera_info",
    "write_camera_info",
]
