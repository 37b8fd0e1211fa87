"""Measure the corner noise that counts: how far off views of real cameras are along what moves a camera.

    python experiments/corner_noise.py DIR

DIR as for real_cameras.py. Each camera is calibrated from all its views. Then each view alone is given the
camera back: what its residuals lose along the eight directions in which a camera moves points (poses taken
out) is the error that a calibration from that view would take for camera. Its root mean square a direction is
the measured sigma, to be compared with the one that the estimator assumes for the scatter of the view's own
residuals (`fewcal.noise.total_sigma`). Were corner errors independent it would equal the scatter.

Printed for each camera: scatter, measured sigma with a flat board, with a bent one and with the remainder of
the lens too, the sigma assumed, and the correlation of the residuals of neighbouring corners; then the same
ratio over the tilt of the board.
"""

from __future__ import annotations

import argparse
import itertools
import os
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray
from real_cameras import load

import fewcal
from fewcal.adjustment import POSE, Estimate
from fewcal.constraints import Normal, Priors
from fewcal.map_estimator import estimate_map
from fewcal.noise import total_sigma
from fewcal.verdict import tilt_deg
from fewcal.views import stack_views

Array = NDArray[np.float64]

CAMERA = 8
NONE = Normal(0.0, 1e-9)
MODELS = {
    "flat": Priors(board_bend=NONE, lens_remainder=NONE),
    "bent": Priors(lens_remainder=NONE),
    "bent, remainder": Priors(),
}
TILTS_DEG = (0, 15, 25, 35, 90)
NEIGHBOUR = 1.2
"""Largest distance of neighbours in spacings of the board."""


class Sample(NamedTuple):
    """One view within a calibration from all views.

    Attributes
    ----------
    scatter : float
        Of what is left when camera and pose are free, pixels.
    sigma : float
        Measured along the directions of the camera, pixels.
    alike : float
        Correlation of the residuals of neighbours.
    tilt_deg : float
    """

    scatter: float
    sigma: float
    alike: float
    tilt_deg: float


def samples(views: list[fewcal.View], found: Estimate) -> list[Sample]:
    """Every view with points enough."""
    columns = found.adjustment.jacobian(found.geometry)[0]
    tilts = tilt_deg(found.geometry.rotation[0])
    # The camera came from all views, which took this share of the error.
    share = 1 - 1 / len(views)
    kept = []
    for view, of_view, tilt in zip(views, columns, tilts, strict=True):
        freedom = 2 * len(view) - POSE - CAMERA
        if freedom < 10:
            continue
        rows = of_view[:, :, : len(view)]
        residual = rows[-1].ravel()
        basis, _ = np.linalg.qr(_unit(rows[: POSE + CAMERA].reshape(POSE + CAMERA, -1).T))
        pose, camera = basis[:, :POSE], basis[:, POSE:]
        along = ((camera.T @ residual) ** 2).sum()
        left = ((residual - pose @ (pose.T @ residual)) ** 2).sum() - along
        alike = _neighbours_alike(view.object_points, rows[-1])
        kept.append(Sample(np.sqrt(left / freedom), np.sqrt(along / CAMERA / share), alike, float(tilt)))
    return kept


def _unit(columns: Array) -> Array:
    scaled: Array = columns / np.linalg.norm(columns, axis=0)
    return scaled


def _neighbours_alike(points: Array, residual: Array) -> float:
    apart = np.linalg.norm(points[:, None] - points, axis=-1)
    np.fill_diagonal(apart, np.inf)
    near = apart < NEIGHBOUR * np.median(apart.min(axis=1))
    return float((residual.T @ residual)[near].mean() / (residual**2).sum(axis=0).mean())


def rms(values: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    paths = sorted(parser.parse_args().folder.glob("**/corners.npz"))
    print("| camera | views | scatter | " + " | ".join(MODELS) + " | assumed | neighbours alike |")
    print("|---" * (len(MODELS) + 5) + "|")
    everything: list[Sample] = []
    ratios = []
    for path in paths:
        views, size = load(path)
        stack = stack_views(views)
        of_model = [samples(views, estimate_map(stack, size, priors)) for priors in MODELS.values()]
        sigmas = [rms(np.array([s.sigma for s in kept])) for kept in of_model]
        last = np.array(of_model[-1])
        assumed = rms(total_sigma(last[:, 0]))
        ratios.append([sigma / assumed for sigma in sigmas])
        everything += of_model[-1]
        cells = [f"{value:.2f}" for value in (rms(last[:, 0]), *sigmas, assumed, last[:, 2].mean())]
        print(f"| {path.parent.name} | {len(views)} | " + " | ".join(cells) + " |", flush=True)
    print("\nMeasured over assumed, root mean square over cameras, and standard deviation of its logarithm:")
    for name, column in zip(MODELS, np.array(ratios).T, strict=True):
        print(f"{name}: {rms(column):.2f}, {np.log(column).std():.2f}")
    print()
    scatter, sigma, _, tilt = np.array(everything).T
    for low, high in itertools.pairwise(TILTS_DEG):
        chosen = (tilt >= low) & (tilt < high)
        ratio = np.median((sigma / total_sigma(scatter))[chosen])
        print(f"tilt {low} to {high} deg: {chosen.sum()} views, median ratio {ratio:.2f}")


if __name__ == "__main__":
    main()
