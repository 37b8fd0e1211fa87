"""What the command `fewcal` can be given, and its help."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NoReturn, TypeAlias

from fewcal.calibration import METHODS
from fewcal.errors import InvalidInput
from fewcal.sheet import PAPERS_MM
from fewcal.sheet_files import DPI
from fewcal.verdict import Thresholds

Action: TypeAlias = Callable[[argparse.Namespace], int]
"""Runs a subcommand and returns the exit code."""

MAX_IMAGE_SIDE = 100_000
"""Pixels; no camera has as many."""


_EXIT_CODES = """
exit codes:
   0  calibrated and usable
   1  calibrated but not usable: everything is written, the verdict says why
   2  bad usage or input
   3  no calibration possible
  70  a defect of fewcal, to be reported
"""

_CALIBRATE = """
Calibrate a camera from a recording, images, or a folder of images that show a board.

One view of a board tilted by 30 to 60 degrees is enough for a first answer, two tilted about different axes
for a good one. The answer comes with error bars; when the views do not determine the camera, it says so.

examples:
  fewcal calibrate arm.mcap --board chessboard:9x6:0.025
  fewcal calibrate rosbag2_folder --topic /camera/image_raw --board chessboard:9x6:0.025 --out result
  fewcal calibrate photo1.jpg photo2.jpg --board chessboard:9x6:0.025 --json
  fewcal calibrate coin.jpg --board points:coin.txt        with coin.pixels.txt beside coin.jpg

boards, lengths in metres:
  chessboard:9x6:0.025                 interior corners (a board of 10x7 squares is 9x6), edge of a square
  charuco:7x5:0.04:0.03:DICT_5X5_100   squares, edge of a square and of a marker, dictionary of OpenCV
  aprilgrid:6x6:0.088:0.3:tag36h11     tags as Kalibr prints them, edge of a tag, gap as a share of it, family
  circles:10x7:0.02                    circles, from one to the next
  acircles:4x11:0.02                   circles in a row, rows, half the distance of two in a row
"""

_BOARD = """
Write a board as it is to be printed, at true scale, with a ruler to check the printer.

examples:
  fewcal board chessboard:9x6:0.025 --paper A4 --output board.pdf
  fewcal board chessboard:11x8:0.08 --paper 1000x800 --output board.svg

Print at 100 %, not fitted to the page, lay the sheet flat on something stiff, and measure it: what the
calibration is told is what counts, not what was meant to be printed.
"""

_PLAY = """
Publish a recording on its topics with its timing, on ROS 2. It needs rclpy and the recorded message types.

It waits up to ten seconds until somebody subscribes, so that nothing is lost, and then plays all the same.
Header stamps are those of the recording, in every round of --loop. SIGINT (Ctrl-C) and SIGTERM end it.

examples:
  fewcal play arm.mcap
  fewcal play wrist.bag --rate 0.5 --loop --topic /wrist_camera/image_raw:=/image
  fewcal play rosbag2_folder --topic /camera/image_raw --topic /camera/camera_info --qos best_effort
"""


class _Parser(argparse.ArgumentParser):
    """Complains like the rest of the command: one sentence, without repeating the usage."""

    def error(self, message: str) -> NoReturn:
        raise InvalidInput(f"{message}; {self.prog} --help says more.")


class _Version(argparse.Action):
    """Prints the version that is installed, which only who asks waits for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from importlib.metadata import version

        print(f"fewcal {version('fewcal')}")
        parser.exit()


def make_parser(actions: Mapping[str, Action]) -> argparse.ArgumentParser:
    """Make the parser of the command; what it parses has the action that was asked for as its ``run``.

    Parameters
    ----------
    actions : mapping of str to callable
        By the name of the subcommand; each takes what was parsed and returns the exit code.
    """
    parser = _Parser(
        prog="fewcal",
        description="Camera calibration from one or two views of a board, with honest error bars.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    _add_calibrate(commands, actions)
    _add_info(commands, actions)
    _add_board(commands, actions)
    _add_play(commands, actions)
    return parser


def _add_calibrate(commands: argparse._SubParsersAction[_Parser], actions: Mapping[str, Action]) -> None:
    command = commands.add_parser(
        "calibrate",
        help="calibrate a camera from a recording or images",
        description=_CALIBRATE,
        epilog=_EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.set_defaults(run=actions["calibrate"])
    command.add_argument(
        "sources",
        type=_named,
        nargs="+",
        metavar="SOURCE",
        help="a .mcap, .db3 or .bag file, a rosbag2 folder, images, or a folder of images; with points:FILE "
        "images that have NAME.pixels.txt beside them, or these files",
    )
    command.add_argument(
        "--board", required=True, help="what the views show, such as chessboard:9x6:0.025 (sizes in metres)"
    )
    command.add_argument("--topic", help="image topic, when the recording has several")
    command.add_argument(
        "--views",
        type=_view_count,
        default=2,
        metavar="N",
        help='views to calibrate from, 1, 2, ... or "all" (default 2); with fewer good ones it takes those',
    )
    command.add_argument(
        "--select",
        choices=("best", "first"),
        default="best",
        help="best: look at the whole recording and take the views that leave the smallest error bars "
        "(default); first: take views as the live node does, and stop when they are enough",
    )
    command.add_argument(
        "--method",
        choices=METHODS,
        default="map",
        help="map: the default estimator; zhu2020: the paper's; zhang: for comparison",
    )
    command.add_argument(
        "--focal-px",
        nargs=2,
        type=float,
        metavar=("F", "SD"),
        help="the focal length, when the lens is known: mean and standard deviation in pixels",
    )
    command.add_argument(
        "--max-focal-std",
        type=float,
        default=Thresholds().focal_std,
        metavar="SHARE",
        help="relative error of the focal length up to which a camera is usable (default %(default)s)",
    )
    command.add_argument(
        "--image-size",
        nargs=2,
        type=_pixel_count,
        metavar=("WIDTH", "HEIGHT"),
        help="with points:FILE, when a SOURCE is a file of pixels without its image",
    )
    command.add_argument("--camera-name", default="camera", metavar="NAME", help="name in camera.yaml")
    command.add_argument(
        "--out", type=_path, metavar="DIR", help="folder that receives camera.yaml and calibration.json"
    )
    command.add_argument("--json", action="store_true", help="print the result as JSON, and nothing else")


def _add_info(commands: argparse._SubParsersAction[_Parser], actions: Mapping[str, Action]) -> None:
    command = commands.add_parser(
        "info", help="list the topics of a recording", description="List what a recording holds."
    )
    command.set_defaults(run=actions["info"])
    command.add_argument(
        "recording", type=_named, metavar="BAG", help="a .mcap, .db3 or .bag file, or a rosbag2 folder"
    )


def _add_board(commands: argparse._SubParsersAction[_Parser], actions: Mapping[str, Action]) -> None:
    command = commands.add_parser(
        "board",
        help="write a board to be printed, as PDF, SVG or PNG",
        description=_BOARD,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.set_defaults(run=actions["board"])
    command.add_argument("board", metavar="BOARD", help="such as chessboard:9x6:0.025 (sizes in metres)")
    command.add_argument(
        "--output", required=True, type=Path, metavar="FILE", help="a file that ends in .pdf, .svg or .png"
    )
    command.add_argument(
        "--paper",
        default="A4",
        metavar="SIZE",
        help=f"{', '.join(PAPERS_MM)}, or width and height in mm, such as 900x600 (default A4)",
    )
    command.add_argument(
        "--dpi", type=float, default=DPI, metavar="N", help="pixels per inch of a PNG (default %(default)s)"
    )


def _add_play(commands: argparse._SubParsersAction[_Parser], actions: Mapping[str, Action]) -> None:
    command = commands.add_parser(
        "play",
        help="publish a recording on its topics (needs ROS 2)",
        description=_PLAY,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.set_defaults(run=actions["play"])
    command.add_argument(
        "recording", type=_named, metavar="BAG", help="a .mcap, .db3 or .bag file, or a rosbag2 folder"
    )
    command.add_argument(
        "--rate", type=_rate, default=1.0, metavar="R", help="speed, 2 for twice that of the recording"
    )
    command.add_argument("--loop", action="store_true", help="begin anew at the end, until interrupted")
    command.add_argument(
        "--qos",
        choices=("reliable", "best_effort"),
        default="reliable",
        help="reliability of the publishers (default reliable, which serves subscribers of either kind)",
    )
    command.add_argument(
        "--topic",
        action="append",
        default=[],
        metavar="A[:=B]",
        help="A:=B publishes the recorded topic A as B; A alone plays only what is mentioned; repeatable",
    )


def _named(text: str) -> str:
    """Refuse nothing, which as a path would be the current folder: a variable of a script may be empty."""
    if not text:
        raise argparse.ArgumentTypeError("the name is empty; give one, or . for the current folder")
    return text


def _path(text: str) -> Path:
    return Path(_named(text))


def _rate(text: str) -> float:
    try:
        rate = float(text)
    except ValueError:
        rate = 0.0
    if not (rate > 0 and math.isfinite(rate)):
        raise argparse.ArgumentTypeError(f"{text!r} is not a speed; give a number above 0, such as 0.5")
    return rate


def _pixel_count(text: str) -> int:
    if not text.isdecimal() or not 2 <= int(text) <= MAX_IMAGE_SIDE:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of pixels; give 2 to {MAX_IMAGE_SIDE}")
    return int(text)


def _view_count(text: str) -> int | None:
    if text == "all":
        return None
    try:
        count = int(text)
    except ValueError:
        count = 0
    if count < 1:
        raise argparse.ArgumentTypeError(f'{text!r} is not a number of views; give 1, 2, ... or "all"')
    return count
