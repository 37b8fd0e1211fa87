"""The figures of the paper's synthetic study: 5, 7 and 9 (success), 6, 8 and 10 (bias), and 12."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray
from paper_trials import CASES, Outcome

mpl.use("Agg")
from matplotlib import pyplot as plt

Array = NDArray[np.float64]

COLOURS = {"map": "C2", "zhu2020": "C0", "zhang": "k"}
"""Methods that are drawn: green, and blue and black as in the paper."""
PATTERN = ListedColormap(["#4472c4", "#ed9b33"])
"""Failure and success, in the paper's colours."""
FIGURES = {"one": (5, 6), "two": (7, 8), "quantised": (9, 10)}
SHOWN = ("fx", "fy", "u0", "v0", "k1", "k2")
"""Parameters of figure 12."""
FLOOR = 1e-12
"""Smaller relative errors are rounding, and drawn as this."""


def draw(name: str, outcomes: Sequence[Outcome], folder: Path) -> None:
    """Draw the figures of one case into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    methods = {method: [o for o in outcomes if o.method == method] for method in COLOURS}
    methods = {method: of for method, of in methods.items() if of}
    if name == "figure12":
        _save(_errors(name, methods), folder / "zhu2020_figure_12.png")
        return
    for number, figure in zip(FIGURES[name], (_success(methods), _bias(name, methods)), strict=True):
        figure.suptitle(f"{CASES[name].title} (figure {number} of the paper)")
        _save(figure, folder / f"zhu2020_figure_{number}.png")


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=80)
    plt.close(figure)


def _grid(outcomes: Sequence[Outcome], values: Sequence[float]) -> tuple[Array, Array, Array]:
    """Tilts, columns, and values (columns, tilts); NaN where no trial was run."""
    tilts, tilt = np.unique([o.tilt_deg for o in outcomes], return_inverse=True)
    columns, column = np.unique([o.columns for o in outcomes], return_inverse=True)
    grid = np.full((len(columns), len(tilts)), np.nan)
    grid[column, tilt] = values
    return tilts, columns, grid


def _success(methods: dict[str, list[Outcome]]) -> Figure:
    """Pattern over angle and number of points, and frequencies over each."""
    figure, axes = plt.subplots(1, len(methods) + 2, figsize=(15, 3.6), layout="constrained")
    by_points, by_tilt = axes[-2:]
    for axis, (method, of) in zip(axes, methods.items(), strict=False):
        tilts, columns, good = _grid(of, [float(o.success) for o in of])
        axis.pcolormesh(tilts, 6 * columns, good, cmap=PATTERN, vmin=0, vmax=1, shading="nearest")
        axis.set(title=f"{method}: {sum(o.success for o in of)}", xlabel="shooting angle, degrees")
        by_points.plot(6 * columns, np.nanmean(good, axis=1), color=COLOURS[method], label=method)
        by_tilt.plot(tilts, np.nanmean(good, axis=0), color=COLOURS[method])
    axes[0].set_ylabel("points")
    by_points.set(xlabel="points", ylabel="frequency of success", ylim=(-0.03, 1.03))
    by_tilt.set(xlabel="shooting angle, degrees", ylim=(-0.03, 1.03))
    by_points.legend()
    return figure


def _bias(name: str, methods: dict[str, list[Outcome]]) -> Figure:
    """Mean and standard deviation of the bias over successful trials, one bar a parameter and method."""
    names = CASES[name].parameters
    figure, axes = plt.subplots(2, 1, figsize=(12, 6), sharex=True, layout="constrained")
    width = 0.8 / len(methods)
    for i, (method, of) in enumerate(methods.items()):
        bias = np.array([o.bias for o in of if o.success])
        if not len(bias):
            continue
        place = np.arange(len(names)) + (i - (len(methods) - 1) / 2) * width
        for axis, values in zip(axes, (np.abs(bias.mean(axis=0)), bias.std(axis=0)), strict=True):
            axis.bar(place, np.maximum(values, 1e-25), width, color=COLOURS[method], label=method)
    for axis, label in zip(axes, ("|mean|", "standard deviation"), strict=True):
        axis.set(yscale="log", ylabel=f"{label} of the bias")
    axes[0].legend()
    axes[1].set_xticks(np.arange(len(names)), names)
    axes[1].set_xlabel("pixels, px$^{-2}$, px$^{-4}$, rad, metres; successful trials")
    return figure


def _errors(name: str, methods: dict[str, list[Outcome]]) -> Figure:
    """Relative error of parameters over angle and number of points."""
    case = CASES[name]
    camera = case.camera
    truth = dict(zip(("fx", "fy", "u0", "v0"), camera.intrinsics[:4], strict=True))
    truth |= dict(zip(("k1", "k2"), camera.pixel_distortion[:2], strict=True))
    figure, axes = plt.subplots(
        len(methods), len(SHOWN), figsize=(15, 2.2 * len(methods) + 0.8), sharex=True, sharey=True,
        layout="constrained", squeeze=False,
    )  # fmt: skip
    scale = LogNorm(FLOOR, 1.0)
    for row, (method, of) in zip(axes, methods.items(), strict=True):
        row[0].set_ylabel(f"{method}\npoints")
        for axis, parameter in zip(row, SHOWN, strict=True):
            i = case.parameters.index(parameter)
            tilts, columns, error = _grid(of, [abs(o.bias[i] / truth[parameter]) for o in of])
            error = np.maximum(error, FLOOR)
            axis.pcolormesh(tilts, 6 * columns, error, norm=scale, shading="nearest")
            axis.set_title(parameter)
    figure.colorbar(ScalarMappable(scale), ax=axes, label="relative error; white: no answer")
    figure.supxlabel("shooting angle, degrees")
    figure.suptitle(f"{case.title} of the paper")
    return figure
