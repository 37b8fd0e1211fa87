"""The command `fewcal` until its imports are done."""

from __future__ import annotations

import os
import signal
from typing import NoReturn

INTERRUPTED = 130
"""Exit code, as a shell reports it: 128 and the number of the signal."""


def main() -> int:
    """Run the command, see :func:`fewcal_ros.cli.main`; an interrupt before it is imported is quiet too."""
    signal.signal(signal.SIGINT, _end)
    from .cli import main as run

    signal.signal(signal.SIGINT, signal.default_int_handler)
    return run()


def _end(*_: object) -> NoReturn:
    os.write(2, b"fewcal: Interrupted.\n")
    os._exit(INTERRUPTED)
