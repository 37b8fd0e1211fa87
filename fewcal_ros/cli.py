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
from typing import TYPE_CHECKING

from .threads import SINGLE_THREAD

os.environ.setdefault(*SINGLE_THREAD)

from fewcal.boards import Board, KnownObject, parse_board, pose_ambiguity
from fewcal.camera_info import check_camera_name, write_camera_info
from fewcal.constraints import Priors
from fewcal.errors import DegenerateViews, FewcalError, InvalidInput
from fewcal.files import write_atomically
from fewcal.sheet import lay_out
from fewcal.sheet_files import write_sheet
from fewcal.verdict import Thresholds

from .arguments import make_parser
from .command import INTERRUPTED, complain, discard
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

CAMERA, REPORT = "camera.yaml", "calibration.json"
"""What is written to the folder of --out."""
USABLE, NOT_USABLE, BAD_INPUT, NO_CALIBRATION = 0, 1, 2, 3
PIPE_CLOSED = 141
"""What a shell reports for a command that SIGPIPE (13) ended: 128 and the signal."""


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
        discard(sys.stdout)
        if isinstance(error, BrokenPipeError):  # its reader has seen enough
            return PIPE_CLOSED
        return _complain(f"The output cannot be written: {error.strerror}.", BAD_INPUT)


def _run(arguments: Sequence[str] | None) -> int:
    try:
        options = make_parser(
            {"calibrate": _calibrate, "info": _info, "board": _board, "play": _play}
        ).parse_args(arguments)
    except SystemExit:  # argparse has printed the help or the version
        _say("")
        return USABLE
    return int(options.run(options))


def _check(options: argparse.Namespace) -> None:
    """Refuse options of `calibrate` that cannot be, alone or together."""
    if not 0 < options.max_focal_std <= 1:
        raise InvalidInput("--max-focal-std must be above 0 and at most 1, for example 0.02 for 2 %.")
    if options.select == "first" and options.views is None:
        raise InvalidInput("--select first stops when there are enough views; say how many with --views N.")
    if options.focal_px and options.method != "map":
        raise InvalidInput(
            f"--focal-px is for the method map; {options.method} uses nothing known beforehand."
        )
    if options.focal_px and not all(0 < value < math.inf for value in options.focal_px):
        raise InvalidInput("--focal-px takes two numbers above zero, the focal length and its one sigma.")
    check_camera_name(options.camera_name)


def _calibrate(options: argparse.Namespace) -> int:
    _check(options)
    settings = Settings(
        board=parse_board(options.board),
        views=options.views,
        select=options.select,
        method=options.method,
        priors=Priors(focal_px=tuple(options.focal_px) if options.focal_px else None),
        thresholds=Thresholds(focal_std=options.max_focal_std),
    )
    with _open(options, settings.board) as reader:
        if options.out is not None:  # better now than after all the work
            _make_folder(options.out)
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
    try:
        if options.out is not None:
            write_atomically(options.out / REPORT, report)
            write_camera_info(options.out / CAMERA, outcome.calibration, camera_name=options.camera_name)
    finally:  # a full disk does not cost the result
        _say(report if options.json else as_text(outcome))
    if options.out is not None and not options.json:
        _say(f"Written: {options.out / CAMERA}, {options.out / REPORT}\n")
    return USABLE if outcome.calibration.verdict.usable else NOT_USABLE


def _open(options: argparse.Namespace, board: Board) -> FrameReader | PixelFrames:
    if isinstance(board, KnownObject):
        if options.topic is not None:
            raise InvalidInput("--topic is for recordings; with --board points:FILE there are images.")
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
    for name in (CAMERA, REPORT):
        if (folder / name).is_dir():
            raise InvalidInput(f"{folder / name} is a folder, where a file is to be written; remove it.")


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
    complain("fewcal: " + " ".join(sentence.splitlines()))
    return code


if __name__ == "__main__":
    sys.exit(main())
