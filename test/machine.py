"""What the machine that runs the tests has to spare."""

from __future__ import annotations

import os


def crowding() -> float:
    """Processes that want a core, for each core there is, 1 at least: everything takes so much longer."""
    return max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))
