"""The command `fewcal` until its imports are done."""

from __future__ import annotations

import os
import signal
import sys
import traceback
from typing import NoReturn, TextIO

INTERRUPTED, TERMINATED = 130, 143
"""Exit codes, as a shell reports them: 128 and the number of the signal."""
DEFECT = 70
"""Exit code of an error in the program itself, as in sysexits.h."""
_DEFECTIVE = "fewcal: This is a defect of fewcal; please report it with the lines above."
_STDOUT, _STDERR = 1, 2


def main() -> int:
    """Run the command, see :func:`fewcal_ros.cli.main`; an interrupt before it is imported is quiet too."""
    _fill_closed_streams()
    signal.signal(signal.SIGINT, _end)
    from .cli import main as run

    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, _wind_up)
    try:
        return run()
    except Exception:
        # An interpreter that ends so has the exit code of a camera that is not usable.
        complain(traceback.format_exc() + _DEFECTIVE)
        return DEFECT


def complain(text: str) -> None:
    """Print on stderr. Where nobody can read it (a full disk, a closed pipe) nothing is lost for that."""
    try:
        print(text, file=sys.stderr, flush=True)
    except OSError:
        discard(sys.stderr)


def discard(stream: TextIO) -> None:
    """Send what is still unwritten to nowhere, so that the interpreter does not fail over it at its end."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


def _fill_closed_streams() -> None:
    """Let what a shell has closed (2>&-) lead nowhere: the next file to be opened would get its number."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= _STDERR:
        pass
    os.close(number)
    sys.stdout = sys.stdout or open(_STDOUT, "w", closefd=False)  # noqa: SIM115
    sys.stderr = sys.stderr or open(_STDERR, "w", closefd=False)  # noqa: SIM115


def _wind_up(*_: object) -> NoReturn:
    """End as after an error: what was written for a while, such as a recording decompressed, is removed."""
    sys.exit(TERMINATED)


def _end(*_: object) -> NoReturn:
    os.write(2, b"fewcal: Interrupted.\n")
    os._exit(INTERRUPTED)
