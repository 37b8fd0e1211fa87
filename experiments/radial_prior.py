"""Fit the prior of the radial distortion to published calibrations, and compare kinds of priors.

    python experiments/radial_prior.py cameras.csv

The table has a row a camera: repo, width, height, fx, model, k1, k2, k3. Taken are those of plumb_bob or
radtan without k3, at most eight of a repository. Printed for each prior: the logarithm of its likelihood, the
same of repositories that are left out of the fit in turn, a tenth of them each time, and its parameters: for
one t mean, slope, triangle of the scale matrix (the diagonal as logarithms) and ln nu; for the mixture the
log odds of the nearly straight lenses, their a1, a2, the k1, k2 of the others, and both triangles.
"""

from __future__ import annotations

import argparse
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
from scipy.special import gammaln

Array = NDArray[np.float64]

FROM_A_REPOSITORY = 8
"""Cameras taken of one repository at most: some hold a third of all."""
FOLDS = 10
REFERENCE = 0.85
"""f / W at which the mean of the single t stands."""
NU = (1.5, 6.0)
"""Degrees of freedom of the mixture: near the most likely ones, which ten folds do not prefer."""


class Cameras(NamedTuple):
    """Scale-free radial terms (M, 2), x = ln(f / W) - ln REFERENCE within [-1, 1] and rc (M,); fold (M,)."""

    terms: Array
    x: Array
    corner: Array
    fold: NDArray[np.intp]

    def take(self, items: NDArray[np.bool_]) -> Cameras:
        """Keep some."""
        return Cameras(*(part[items] for part in self))


def load(path: Path) -> Cameras:
    """Read the table."""
    seen: Counter[str] = Counter()
    rows = []
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            k1, k2, k3 = (float(row[name] or 0) for name in ("k1", "k2", "k3"))
            if (
                row["model"] not in ("plumb_bob", "radtan")
                or k3 != 0
                or seen[row["repo"]] >= FROM_A_REPOSITORY
            ):
                continue
            seen[row["repo"]] += 1
            width, height, focal = float(row["width"]), float(row["height"]), float(row["fx"])
            corner = math.hypot(width, height) / 2 / focal
            x = np.clip(math.log(focal / max(width, height) / REFERENCE), -1, 1)
            fold = zlib.crc32(row["repo"].encode()) % FOLDS
            rows.append((k1 * corner**2, k2 * corner**4, x, corner, fold))
    values = np.array(rows)
    return Cameras(values[:, :2], values[:, 2], values[:, 3], values[:, 4].astype(np.intp))


def log_t(offset: Array, triangle: Array, nu: float) -> Array:
    """Logarithm of a bivariate t at offsets (M, 2) from its mean; the triangle is ln l11, l21, ln l22."""
    first = offset[:, 0] / math.exp(triangle[0])
    second = (offset[:, 1] - triangle[1] * first) / math.exp(triangle[2])
    constant = gammaln((nu + 2) / 2) - gammaln(nu / 2) - math.log(nu * math.pi) - triangle[0] - triangle[2]
    return np.asarray(constant - (nu + 2) / 2 * np.log1p((first**2 + second**2) / nu))


def single(p: Array, cameras: Cameras) -> Array:
    """One t whose mean follows the focal length."""
    return log_t(cameras.terms - p[:2] - cameras.x[:, None] * p[2:4], p[4:7], math.exp(p[7]))


def mixture(p: Array, cameras: Cameras) -> Array:
    """Lenses whose a1, a2 lie about one point, and lenses whose k1, k2 do."""
    barrel = np.stack([p[3] * cameras.corner**2, p[4] * cameras.corner**4], axis=1)
    return np.logaddexp(
        log_t(cameras.terms - p[1:3], p[5:8], NU[0]) - np.logaddexp(0, -p[0]),
        log_t(cameras.terms - barrel, p[8:11], NU[1]) - np.logaddexp(0, p[0]),
    )


KINDS: dict[str, tuple[Callable[[Array, Cameras], Array], list[float]]] = {
    "one t": (single, [-0.1, 0.02, 0.3, -0.09, -2.2, -0.04, -4.0, 0.7]),
    "mixture": (mixture, [0.3, 0.01, -0.015, -0.26, 0.054, -3.3, -0.025, -3.8, -2.8, -0.026, -4.2]),
}


def fit(density: Callable[[Array, Cameras], Array], start: list[float], cameras: Cameras) -> Array:
    """Parameters of the highest likelihood."""
    return np.asarray(minimize(lambda p: -density(p, cameras).sum(), start, method="BFGS").x)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("table", type=Path)
    cameras = load(parser.parse_args().table)
    print(f"{len(cameras.x)} cameras\n\n| prior | ln likelihood | of what is left out | parameters |")
    print("|---|---|---|---|")
    for name, (density, start) in KINDS.items():
        p = fit(density, start, cameras)
        left_out = 0.0
        for fold in range(FOLDS):
            kept = cameras.fold != fold
            left_out += density(fit(density, start, cameras.take(kept)), cameras.take(~kept)).sum()
        values = ", ".join(f"{value:.4g}" for value in p)
        print(f"| {name} | {density(p, cameras).sum():.1f} | {left_out:.1f} | {values} |")


if __name__ == "__main__":
    main()
