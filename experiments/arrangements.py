"""Degenerate and sound arrangements of views to draw at random, and what the verdict says of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray
from synthetic import BOARDS, SPANS, Scene, draw_camera, place, real, rotation

import fewcal

Array = NDArray[np.float64]

NAMES = {
    "Fronto-parallel": "fronto-parallel",
    "Parallel planes": "parallel planes",
    "Turn about the normal": "turn about the normal",
    "Board too small": "too small",
}
"""What the verdict's sentences begin with; no such sentence means a sound arrangement."""
USUAL, SMALL = (SPANS["far"][0], SPANS["near"][1]), (0.06, 0.13)
"""Diagonal of the board seen face on, over the diagonal of the image."""
DEGENERATE_DEG = 3.0
"""Angle up to which degenerate arrangements deviate from the exact one."""


def fronto_parallel(rng: np.random.Generator) -> tuple[list[Array], tuple[float, float]]:
    """Up to three boards parallel to the image, but for 3 degrees."""
    return [_turn(rng, 0, DEGENERATE_DEG) for _ in range(rng.integers(1, 4))], USUAL


def parallel(rng: np.random.Generator) -> tuple[list[Array], tuple[float, float]]:
    """One tilted board moved without turning, but for 3 degrees between any two."""
    first = _turn(rng, 15, 60)
    return [first] + [_wobble(rng) @ first for _ in range(rng.integers(1, 3))], USUAL


def turned(rng: np.random.Generator) -> tuple[list[Array], tuple[float, float]]:
    """One tilted board turned in its own plane."""
    first = _turn(rng, 15, 60)
    rolls = rng.uniform(15, 165, rng.integers(1, 3)) * rng.choice([-1, 1])
    return [first] + [_wobble(rng) @ first @ rotation(0, 0, roll) for roll in rolls], USUAL


def small(rng: np.random.Generator) -> tuple[list[Array], tuple[float, float]]:
    """Two or three tilted boards far away."""
    return _tilted(rng, int(rng.integers(2, 4))), SMALL


def sound(rng: np.random.Generator) -> tuple[list[Array], tuple[float, float]]:
    """One to three boards tilted about different axes."""
    return _tilted(rng, int(rng.integers(1, 4))), USUAL


ARRANGEMENTS: dict[str, Callable[[np.random.Generator], tuple[list[Array], tuple[float, float]]]] = {
    "fronto-parallel": fronto_parallel,
    "parallel planes": parallel,
    "turn about the normal": turned,
    "too small": small,
    "sound": sound,
}
"""Rotations of the boards, and the range of their spans, by name."""


def reasons_for(job: tuple[str, int]) -> tuple[str, ...]:
    """Verdict on one draw of an arrangement, with errors as real boards have them."""
    kind, number = job
    rng = np.random.default_rng([list(ARRANGEMENTS).index(kind), number, 1])
    turns, spans = ARRANGEMENTS[kind](rng)
    camera, size = draw_camera(rng)
    board = BOARDS[rng.integers(len(BOARDS))]
    span = rng.uniform(*spans)
    scene = Scene(camera, size, board, np.stack([place(camera, size, board, R, span, rng) for R in turns]))
    try:
        return fewcal.calibrate(real(scene, rng), size).verdict.reasons
    except fewcal.FewcalError as error:
        return (str(error),)


def named(reasons: Iterable[str]) -> set[str]:
    """Arrangements that the sentences of a verdict name, "sound" when they name none."""
    names = {name for reason in reasons for start, name in NAMES.items() if reason.startswith(start)}
    return names or {"sound"}


def _turn(rng: np.random.Generator, least_deg: float, most_deg: float) -> Array:
    return rotation(rng.uniform(least_deg, most_deg), *rng.uniform(0, 360, 2))


def _wobble(rng: np.random.Generator) -> Array:
    return rotation(rng.uniform(0, DEGENERATE_DEG / 2), rng.uniform(0, 360), 0)


def _tilted(rng: np.random.Generator, count: int) -> list[Array]:
    """Boards tilted by 20 to 60 degrees about axes at least 40 degrees apart."""
    start = rng.uniform(0, 360)
    about = start + np.cumsum(rng.uniform(40, 140, count))
    return [rotation(rng.uniform(20, 60), axis, rng.uniform(0, 360)) for axis in about]
