"""The command `fewcal`: print boards, calibrate from recordings or images, list recordings and play them."""

from __future__ import annotations

import argparse
import math
import os
import signal
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from .threads import SINGLE_THREAD

os.environ.setdefault(*SINGLE_THREAD)

from fewcal.boards import Board, KnownObject, parse_board, pose_ambiguity
from fewcal.calibration import METHODS
from fewcal.camera_info import check_camera_name, write_camera_info
from fewcal.constraints import Priors
from fewcal.errors import DegenerateViews, FewcalError, InvalidInput
from fewcal.files import write_atomically
from fewcal.sheet import PAPERS_MM, lay_out
from fewcal.sheet_files import DPI, write_sheet
from fewcal.verdict import Thresholds

from .errors import RosError
from .frames import FrameReader, open_frames
from .messages import Frame
from .offline import Outcome, Settings, calibrate_frames
from .pixel_frames import PixelFrames
from .recordings import RecordingInfo, recording_info
from .report import as_json, as_text

if TYPE_CHECKING:
    from rich.progress import Progress

REDRAW_S = 0.1
"""The progress bar is drawn no more often than this."""

MAX_IMAGE_SIDE = 100_000
"""Pixels; no camera has as many."""

USABLE, NOT_USABLE, BAD_INPUT, NO_CALIBRATION = 0, 1, 2, 3
INTERRUPTED, PIPE_CLOSED = 130, 141
"""What a shell reports for a command that SIGINT (2) or SIGPIPE (13) ended: 128 and the signal."""

_EXIT_CODES = """
exit codes:
  0  calibrated and usable
  1  calibrated but not usable: everything is written, the verdict says why
  2  bad usage or input
  3  no calibration possible
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Parameters
    ----------
    arguments : sequence of str, optional
        Without the name of the program; those of the process when left out.

    Returns
    -------
    int
        The exit code, see ``fewcal calibrate --help``.
    """
    try:
        return _run(arguments)
    except DegenerateViews as error:
        return _complain(str(error), NO_CALIBRATION)
    except FewcalError as error:
        return _complain(str(error), BAD_INPUT)
    except KeyboardInterrupt:
        return _complain("Interrupted.", INTERRUPTED)
    except OSError as error:  # of stdout; those of files are FewcalErrors
        _discard_output()
        if isinstance(error, BrokenPipeError):  # its reader has seen enough
            return PIPE_CLOSED
        return _complain(f"The output cannot be written: {error.strerror}.", BAD_INPUT)


def _run(arguments: Sequence[str] | None) -> int:
    try:
        options = _parser().parse_args(arguments)
    except SystemExit:  # argparse has printed the help
        _say("")
        return USABLE
    return int(options.run(options))


class _Parser(argparse.ArgumentParser):
    """Complains like the rest of the command: one sentence, without repeating the usage."""

    def error(self, message: str) -> NoReturn:
        raise InvalidInput(f"{message}; {self.prog} --help says more.")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="fewcal",
        description="Camera calibration from one or two views of a board, with honest error bars.",
    )
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    command = commands.add_parser(
        "calibrate",
        help="calibrate a camera from a recording or images",
        description=_CALIBRATE,
        epilog=_EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.set_defaults(run=_calibrate)
    command.add_argument(
        "sources",
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
        "--out", type=Path, metavar="DIR", help="folder that receives camera.yaml and calibration.json"
    )
    command.add_argument("--json", action="store_true", help="print the result as JSON, and nothing else")
    info = commands.add_parser(
        "info", help="list the topics of a recording", description="List what a recording holds."
    )
    info.set_defaults(run=_info)
    info.add_argument("recording", metavar="BAG", help="a .mcap, .db3 or .bag file, or a rosbag2 folder")
    _add_board(commands)
    _add_play(commands)
    return parser


def _add_board(commands: argparse._SubParsersAction[_Parser]) -> None:
    command = commands.add_parser(
        "board",
        help="write a board to be printed, as PDF, SVG or PNG",
        description=_BOARD,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.set_defaults(run=_board)
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


def _add_play(commands: argparse._SubParsersAction[_Parser]) -> None:
    command = commands.add_parser(
        "play",
        help="publish a recording on its topics (needs ROS 2)",
        description=_PLAY,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.set_defaults(run=_play)
    command.add_argument("recording", metavar="BAG", help="a .mcap, .db3 or .bag file, or a rosbag2 folder")
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


def _calibrate(options: argparse.Namespace) -> int:
    if not options.max_focal_std > 0:
        raise InvalidInput("--max-focal-std must be above zero, for example 0.02 for 2 %.")
    check_camera_name(options.camera_name)
    settings = Settings(
        board=parse_board(options.board),
        views=options.views,
        select=options.select,
        method=options.method,
        priors=Priors(focal_px=tuple(options.focal_px) if options.focal_px else None),
        thresholds=Thresholds(focal_std=options.max_focal_std),
    )
    if options.out is not None:
        _make_folder(options.out)
    with _open(options, settings.board) as reader:
        try:
            with _progress(reader) as frames:
                outcome = calibrate_frames(frames, settings)
        except DegenerateViews:  # what is damaged may be why
            _warn(reader.warnings)
            raise
    _warn(reader.warnings)
    _warn(filter(None, [pose_ambiguity(settings.board)]))
    outcome = _count_unreadable(outcome, reader)
    report = as_json(outcome)
    if options.out is not None:
        write_camera_info(options.out / "camera.yaml", outcome.calibration, camera_name=options.camera_name)
        write_atomically(options.out / "calibration.json", report)
    if options.json:
        _say(report)
    else:
        _say(as_text(outcome))
        if options.out is not None:
            _say(f"Written: {options.out / 'camera.yaml'}, {options.out / 'calibration.json'}\n")
    return USABLE if outcome.calibration.verdict.usable else NOT_USABLE


def _open(options: argparse.Namespace, board: Board) -> FrameReader | PixelFrames:
    if isinstance(board, KnownObject):
        return PixelFrames(options.sources, tuple(options.image_size) if options.image_size else None)
    if options.image_size:
        raise InvalidInput("--image-size is for files of pixels, with --board points:FILE; images have one.")
    return open_frames(options.sources, options.topic)


def _count_unreadable(outcome: Outcome, reader: FrameReader | PixelFrames) -> Outcome:
    """Count the frames that could not be decoded among those read."""
    outcome.rejected["unreadable"] += reader.skipped
    return Outcome(outcome.calibration, outcome.read + reader.skipped, outcome.with_board, +outcome.rejected)


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInput(f"The folder {folder} cannot be made: {error.strerror}.") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InvalidInput(f"The folder {folder} cannot be written to; choose another or change its mode.")


@contextmanager
def _progress(reader: FrameReader | PixelFrames) -> Iterator[Iterable[Frame]]:
    """Show progress on a terminal; elsewhere nothing."""
    if not sys.stderr.isatty():
        yield reader
        return
    from rich.console import Console  # only a terminal needs it, and it takes its time to import
    from rich.progress import Progress

    # No threads: one that redraws the bar outlives an interrupt, and the process with it.
    with Progress(console=Console(stderr=True), transient=True, auto_refresh=False) as progress:
        yield _counted(reader, progress)


def _counted(reader: FrameReader | PixelFrames, progress: Progress) -> Iterator[Frame]:
    """Pass frames on and move the progress bar."""
    task = progress.add_task("Looking for the board", total=reader.total)
    drawn = float("-inf")
    for frame in reader:
        if time.monotonic() - drawn >= REDRAW_S:
            progress.refresh()
            drawn = time.monotonic()
        yield frame
        progress.advance(task)


def _board(options: argparse.Namespace) -> int:
    sheet = lay_out(parse_board(options.board), options.paper)
    write_sheet(sheet, options.output, options.dpi)
    _say(f"Written: {options.output}, {sheet.width:g} x {sheet.height:g} mm; print it at 100 %.\n")
    return USABLE


def _info(options: argparse.Namespace) -> int:
    info = recording_info(options.recording)
    _say(_info_text(info))
    _warn(info.warnings)
    return USABLE


def _info_text(info: RecordingInfo) -> str:
    duration = "no messages" if info.duration_ns is None else f"{info.duration_ns / 1e9:.3f} s"
    lines = [f"{info.path}: {info.format}, {duration}, {sum(topic.count for topic in info.topics)} messages"]
    wide = max((len(topic.name) for topic in info.topics), default=0)
    type_wide = max((len(topic.type) for topic in info.topics), default=0)
    lines += [f"  {topic.name:{wide}}  {topic.type:{type_wide}}  {topic.count:8d}" for topic in info.topics]
    return "\n".join(lines) + "\n"


def _play(options: argparse.Namespace) -> int:
    # Before the first message and after the last there is nothing to wind up, so both signals just end it.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        try:
            from .player import Playback, play  # all else works where no ROS is installed
        except ImportError as error:
            raise RosError(
                f"fewcal play needs ROS 2 ({error}); source its setup.bash or install fewcal's extra 'ros'."
            ) from error
        playback = Playback(options.rate, options.loop, options.qos == "reliable", tuple(options.topic))
        published = play(options.recording, playback, tell=lambda sentence: _warn([sentence]))
    except KeyboardInterrupt:
        published = 0
    _say(f"{published} messages published.\n")
    return USABLE


def _say(text: str) -> None:
    """Print on stdout, at once: a failure is then met here and not when the interpreter ends."""
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    # The name of a file may hold what the terminal cannot show.
    print(text.encode(encoding, "backslashreplace").decode(encoding), end="", flush=True)


def _warn(warnings: Iterable[str]) -> None:
    for warning in warnings:
        _complain(warning, USABLE)


def _complain(sentence: str, code: int) -> int:
    """Print a sentence on stderr, on one line whatever names it holds."""
    print("fewcal:", " ".join(sentence.splitlines()), file=sys.stderr)
    return code


def _discard_output() -> None:
    """Send what is still unwritten to nowhere, so that the interpreter does not fail over it at its end."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, sys.stdout.fileno())
    os.close(nowhere)


if __name__ == "__main__":
    sys.exit(main())
