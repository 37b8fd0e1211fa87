"""Fit the priors of principal point, tangential terms and aspect ratio, alone and together.

    python experiments/student_priors.py cameras.csv

The table is that of camera_table.py. For each quantity: the logarithm of the likelihood of t priors, the same
of repositories that are left out of the fit in turn, and ln nu and ln scale of each t. Two numbers are either
independent, with a t each, or have a bivariate one.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from camera_table import HEADER, Array, Cameras, Density, load, log_constant, row

Values = Callable[[Cameras], Array]


def alone(values: Values) -> Density:
    """A t for each column."""

    def density(p: Array, cameras: Cameras) -> Array:
        at = values(cameras)
        total = np.zeros(len(at))
        for column, (log_nu, log_scale) in zip(at.T, p.reshape(-1, 2), strict=True):
            total += _log_t(column[:, None], log_nu, log_scale)
        return total

    return density


def together(values: Values) -> Density:
    """One t for all columns, of one scale."""
    return lambda p, cameras: _log_t(values(cameras), p[0], p[1])


def _log_t(at: Array, log_nu: float, log_scale: float) -> Array:
    nu, dimension = math.exp(log_nu), at.shape[1]
    q = ((at / math.exp(log_scale)) ** 2).sum(axis=1)
    found: Array = (
        log_constant(nu, dimension) - dimension * log_scale - (nu + dimension) / 2 * np.log1p(q / nu)
    )
    return found


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("table", type=Path)
    cameras = load(parser.parse_args().table)
    told = cameras.take((cameras.tangential != 0).any(axis=1))
    for name, of, values, scale in (
        ("principal point", cameras, lambda c: c.centre, 0.014),
        ("tangential terms", told, lambda c: c.tangential, 0.001),
        ("aspect ratio", cameras, lambda c: c.log_aspect[:, None], 0.002),
    ):
        start = [0.5, math.log(scale)]
        print(f"\n{name}, {len(of.corner)} cameras\n\n{HEADER}")
        print(row("a t each", alone(values), start * values(of).shape[1], of), flush=True)
        if values(of).shape[1] > 1:
            print(row("one t", together(values), start, of), flush=True)


if __name__ == "__main__":
    main()
