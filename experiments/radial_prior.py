"""Fit the prior of the radial distortion to published calibrations, and compare kinds of priors.

    python experiments/radial_prior.py cameras.csv

The table is that of camera_table.py; taken are cameras of plumb_bob or radtan without k3. Printed for each
prior: the logarithm of its likelihood, the same of repositories that are left out of the fit in turn, a tenth
of them each time, and its parameters: for one t mean, slope, triangle of the scale matrix (the diagonal as
logarithms) and ln nu; for the mixtures the log odds of the nearly straight lenses, their a1, a2, what the
others' are of the powers of rc, and both triangles.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from camera_table import HEADER, Array, Cameras, Density, load, log_constant, row

REFERENCE = 0.85
"""f / W at which the mean of the single t stands."""
NU = (1.5, 3.0)
"""Degrees of freedom of the mixture, rounded: the likelihood of what is left out changes by 3 within a factor
of two."""


def log_t(offset: Array, triangle: Array, nu: float) -> Array:
    """Logarithm of a bivariate t at offsets (M, 2) from its mean; the triangle is ln l11, l21, ln l22."""
    first = offset[:, 0] / math.exp(triangle[0])
    second = (offset[:, 1] - triangle[1] * first) / math.exp(triangle[2])
    constant = log_constant(nu, 2) - triangle[0] - triangle[2]
    return np.asarray(constant - (nu + 2) / 2 * np.log1p((first**2 + second**2) / nu))


def single(p: Array, cameras: Cameras) -> Array:
    """One t whose mean follows the focal length."""
    x = np.clip(cameras.log_focal - math.log(REFERENCE), -1, 1)
    return log_t(cameras.radial - p[:2] - x[:, None] * p[2:4], p[4:7], math.exp(p[7]))


def mixture(powers: tuple[float, float]) -> Callable[[Array, Cameras], Array]:
    """Lenses whose a1, a2 lie about one point, and lenses whose a1, a2 grow with powers of rc."""

    def density(p: Array, cameras: Cameras) -> Array:
        barrel = p[3:5] * cameras.corner[:, None] ** np.array(powers)
        return np.logaddexp(
            log_t(cameras.radial - p[1:3], p[5:8], NU[0]) - np.logaddexp(0, -p[0]),
            log_t(cameras.radial - barrel, p[8:11], NU[1]) - np.logaddexp(0, p[0]),
        )

    return density


START = [0.5, 0.01, -0.015, -0.28, 0.07, -3.3, -0.022, -3.9, -3.0, -0.015, -4.5]
KINDS: dict[str, tuple[Density, list[float]]] = {
    "one t": (single, [-0.1, 0.02, 0.3, -0.09, -2.2, -0.04, -4.0, 0.7]),
    **{
        f"mixture, rc^{a:g} and rc^{b:g}": (mixture((a, b)), START)
        for a, b in ((2, 4), (1, 1), (2, 2), (1.5, 2))
    },
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("table", type=Path)
    cameras = load(parser.parse_args().table, plain=True)
    print(f"{len(cameras.corner)} cameras\n\n{HEADER}")
    for name, (density, start) in KINDS.items():
        print(row(name, density, start, cameras), flush=True)


if __name__ == "__main__":
    main()
