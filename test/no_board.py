"""Pictures that show no board at all, shared by the tests of the detectors."""

from __future__ import annotations

from typing import Any

import numpy as np
from board_pictures import CAMERA, SIZE

from fewcal.rendering import clutter, render

NO_BOARD = (
    "black",
    "saturated",
    "noise",
    "deep noise",
    "one pixel",
    "two rows",
    "flat",
    "narrow",
    "stripes",
    "pixel checks",
    "clutter",
)


def no_board(name: str) -> Any:
    """One of them."""
    rng = np.random.default_rng(3)
    row, column = np.indices((480, 640))
    return {
        "black": lambda: np.zeros((480, 640), np.uint8),
        "saturated": lambda: np.full((480, 640, 3), 255, np.uint8),
        "noise": lambda: rng.integers(0, 256, (480, 640)).astype(np.uint8),
        "deep noise": lambda: rng.integers(0, 65536, (480, 640)).astype(np.uint16),
        "one pixel": lambda: np.zeros((1, 1), np.uint8),
        "two rows": lambda: rng.integers(0, 256, (2, 900)).astype(np.uint8),
        "flat": lambda: rng.integers(0, 256, (20, 20000)).astype(np.uint8),
        "narrow": lambda: rng.integers(0, 256, (20000, 20, 3)).astype(np.uint8),
        "stripes": lambda: (row // 8 % 2 * 255).astype(np.uint8),
        "pixel checks": lambda: ((row + column) % 2 * 255).astype(np.uint8),
        "clutter": lambda: render(CAMERA, SIZE, None, None, background=clutter(SIZE, rng)),
    }[name]()
