"""Calibrate with mrcal, where it is installed, as its command does.

LENSMODEL_OPENCV4, regularised, outliers rejected: a seed from a guess of the focal length, then poses,
pinhole camera, lens, and the shape of the board, each with what is before it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

import fewcal

try:
    import mrcal
except ImportError:
    mrcal = None

Array = NDArray[np.float64]

AVAILABLE = mrcal is not None
LENS = "LENSMODEL_OPENCV4"
SAME = 1e-3
"""Lengths below this share of the board are none."""
FILLED = 0.3
"""Share of a lattice's cells that hold points at least."""
LENS_START = 1e-6
"""Mrcal starts distortions at random numbers as small as this."""


def lattice(views: list[fewcal.View]) -> tuple[Array, float]:
    """Observations (V, rows, columns, 3) of a square lattice, pixels and weight, and its spacing in metres.

    Mrcal knows no other boards. Cells that hold no point have a negative weight, as mrcal wants it.
    """
    points = np.concatenate([view.object_points[:, :2] for view in views])
    origin = points.min(axis=0)
    spacing = _spacing(points - origin)
    cells = [np.rint((view.object_points[:, :2] - origin) / spacing).astype(int) for view in views]
    columns, rows = np.concatenate(cells).max(axis=0) + 1
    if len(np.unique(np.concatenate(cells), axis=0)) < FILLED * columns * rows:
        raise fewcal.DegenerateViews("mrcal: the points lie on no square lattice.")
    observations = np.full((len(views), rows, columns, 3), -1.0)
    for seen, view, cell in zip(observations, views, cells, strict=True):
        seen[cell[:, 1], cell[:, 0]] = np.column_stack([view.image_points, np.ones(len(view))])
    return observations, spacing


def calibrate(views: list[fewcal.View], size: tuple[int, int], warp: bool = True) -> fewcal.Camera:
    """Calibrate one camera; `warp` lets mrcal estimate the shape of the board."""
    try:
        fx, fy, cx, cy, *distortion = _solve(views, size, warp).tolist()
    except RuntimeError as error:
        raise fewcal.DegenerateViews(f"mrcal: {error}") from error
    if not (fx > 0 and fy > 0):
        raise fewcal.DegenerateViews("mrcal: the focal length is not positive.")
    return fewcal.Camera(fx, fy, cx, cy, [*distortion, 0.0])


def _solve(views: list[fewcal.View], size: tuple[int, int], warp: bool) -> Array:
    """Intrinsics (8,) of `LENS`."""
    observations, spacing = lattice(views)
    numbers = np.arange(len(views), dtype=np.int32)
    frame_camera = np.stack([numbers, 0 * numbers], axis=1)
    sizes = np.array([size], dtype=np.int32)
    core, extrinsics, frames = mrcal.seed_stereographic(
        imagersizes=sizes,
        focal_estimate=float(max(size)),
        indices_frame_camera=frame_camera,
        observations=observations,
        object_spacing=spacing,
    )
    # mrcal writes what it finds into these arrays, from where the next stage goes on.
    problem: dict[str, Any] = {
        "intrinsics": core,
        "extrinsics_rt_fromref": extrinsics,
        "frames_rt_toref": frames,
        "points": None,
        "observations_board": observations,
        "indices_frame_camintrinsics_camextrinsics": np.column_stack([frame_camera, 0 * numbers - 1]),
        "observations_point": None,
        "indices_point_camintrinsics_camextrinsics": None,
        "imagersizes": sizes,
        "calibration_object_spacing": spacing,
        "lensmodel": "LENSMODEL_STEREOGRAPHIC",
    }
    _optimise(problem, core=False)
    _optimise(problem)
    lens = np.random.default_rng(0).uniform(-LENS_START, LENS_START, (1, 4))
    problem |= {"lensmodel": LENS, "intrinsics": np.concatenate([core, lens], axis=1)}
    _optimise(problem, lens=True)
    if warp:
        _optimise(problem | {"calobject_warp": np.zeros(2)}, lens=True)
    intrinsics: Array = problem["intrinsics"][0]
    return intrinsics


def _optimise(problem: dict[str, Any], core: bool = True, lens: bool = False) -> None:
    """One stage; the board's shape is among the unknowns where it is there to be filled in."""
    mrcal.optimize(
        **problem,
        do_optimize_intrinsics_core=core,
        do_optimize_intrinsics_distortions=lens,
        do_optimize_calobject_warp="calobject_warp" in problem,
        do_apply_outlier_rejection=lens,
        do_apply_regularization=lens,
    )


def _spacing(points: Array) -> float:
    """Largest length of which the coordinates of all points (N, 2) are multiples, metres (Euclid)."""
    steps = np.unique(points)
    unit = 0.0
    for step in steps.tolist():
        longer, shorter = max(unit, step), min(unit, step)
        while shorter > SAME * steps[-1]:
            longer, shorter = shorter, longer % shorter
            shorter = min(shorter, longer - shorter)
        unit = longer
    return unit
