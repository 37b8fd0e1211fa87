"""The table of published calibrations that the priors are fitted on.

One row a camera: repo, width, height, fx, fy, cx, cy, model, k1, k2, p1, p2, k3. At most eight of a
repository are taken, some of which hold a third of all.
"""

from __future__ import annotations

import csv
import math
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

Array = NDArray[np.float64]

FROM_A_REPOSITORY = 8
FOLDS = 10


class Cameras(NamedTuple):
    """Published cameras, in the estimator's unknowns.

    Attributes
    ----------
    log_focal : (M,) ln(fx / max(width, height))
    log_aspect : (M,) ln(fy / fx)
    centre : (M, 2) principal point from the middle of the image, diagonals
    radial : (M, 2) a1, a2
    tangential : (M, 2) b1, b2
    corner : (M,) rc, half the diagonal over fx
    fold : (M,) of the repository
    """

    log_focal: Array
    log_aspect: Array
    centre: Array
    radial: Array
    tangential: Array
    corner: Array
    fold: NDArray[np.intp]

    def take(self, items: NDArray[np.bool_]) -> Cameras:
        """Keep some."""
        return Cameras(*(part[items] for part in self))


def load(path: Path, plain: bool = False) -> Cameras:
    """Read the table; `plain` takes the cameras of plumb_bob or radtan without k3 alone."""
    seen: Counter[str] = Counter()
    rows = []
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            if plain and (row["model"] not in ("plumb_bob", "radtan") or float(row["k3"] or 0) != 0):
                continue
            if seen[row["repo"]] >= FROM_A_REPOSITORY:
                continue
            seen[row["repo"]] += 1
            names = ("width", "height", "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
            fold = zlib.crc32(row["repo"].encode()) % FOLDS
            rows.append([*(float(row[name] or 0) for name in names), fold])
    width, height, fx, fy, cx, cy, k1, k2, p1, p2, fold_of = np.array(rows).T
    diagonal = np.hypot(width, height)
    corner = diagonal / 2 / fx
    return Cameras(
        np.log(fx / np.maximum(width, height)),
        np.log(fy / fx),
        np.stack([cx - (width - 1) / 2, cy - (height - 1) / 2], axis=1) / diagonal[:, None],
        np.stack([k1 * corner**2, k2 * corner**4], axis=1),
        np.stack([p1, p2], axis=1) * corner[:, None],
        corner,
        fold_of.astype(np.intp),
    )


Density = Callable[[Array, Cameras], Array]
"""Logarithm of the density (M,) of cameras for some parameters."""


def fit(density: Density, start: list[float], cameras: Cameras) -> Array:
    """Parameters of the highest likelihood."""
    return np.asarray(minimize(lambda p: -density(p, cameras).sum(), start, method="BFGS").x)


def row(name: str, density: Density, start: list[float], cameras: Cameras) -> str:
    """One row of a table: likelihood, the same of repositories left out of the fit in turn, parameters."""
    p = fit(density, start, cameras)
    left_out = 0.0
    for fold in range(FOLDS):
        kept = cameras.fold != fold
        left_out += density(fit(density, start, cameras.take(kept)), cameras.take(~kept)).sum()
    values = ", ".join(f"{value:.4g}" for value in p)
    return f"| {name} | {density(p, cameras).sum():.1f} | {left_out:.1f} | {values} |"


HEADER = "| prior | ln likelihood | of what is left out | parameters |\n|---|---|---|---|"


def log_constant(nu: float, dimension: int) -> float:
    """Logarithm of the density of a t at its mean, for a scale matrix of determinant 1."""
    half = (nu + dimension) / 2
    return math.lgamma(half) - math.lgamma(nu / 2) - dimension / 2 * math.log(nu * math.pi)
