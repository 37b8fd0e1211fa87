"""Whether the error bars tell the truth: cameras, views and errors drawn at random, calibrated with map.

    python experiments/coverage.py [--trials 8] [--scenarios assumed,real,...] [--out DIR] [--plots DIR]

`--trials` calibrations for each scenario and tilt of the board, from one view or up to five, near and far;
then a table of how many truths lay within 1, 2 and 3 reported standard deviations (.68, .95 and 1.00 if the
bars are honest), for fx, cx, cy, k1, p1, p2, for a random pixel (`Calibration.projection_std`) and for the
same pixel after the best rotation; then how often the verdict names a degenerate arrangement of views. The
models of cameras and errors stand in synthetic.py. `--out` writes every draw (coverage.csv), `--plots`
draws the shares over the tilt, which needs matplotlib.
"""

from __future__ import annotations

import argparse
import csv
import os
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import astuple, fields
from itertools import product
from pathlib import Path

# One thread a process: the matrices are small, and the processes share the cores.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from arrangements import ARRANGEMENTS, named, reasons_for
from error_bars import QUANTITIES, SCENARIOS, TILTS_DEG, Draw, run


def shares(draws: Sequence[Draw], quantity: str) -> tuple[float, ...]:
    """Share of truths within 1, 2 and 3 reported standard deviations."""
    scores = np.abs([getattr(draw, quantity) for draw in draws])
    return tuple(float((scores < bound).mean()) for bound in (1, 2, 3))


def table(title: str, groups: Iterable[tuple[str, Sequence[Draw]]]) -> None:
    """Print one row a group of draws, as markdown."""
    columns = (title, "n", *QUANTITIES, "focal sd, median", "usable", "of these fx off by > 3 sd")
    print("", "| " + " | ".join(columns) + " |", "|---" * len(columns) + "|", sep="\n")
    for name, draws in groups:
        cells = [" ".join(f"{share:.2f}" for share in shares(draws, quantity)) for quantity in QUANTITIES]
        usable = [draw for draw in draws if draw.usable]
        false = f"{100 * np.mean([abs(draw.fx) > 3 for draw in usable]):.1f} %" if usable else "-"
        sd = f"{100 * np.nanmedian([draw.focal_std for draw in draws]):.2g} %"
        cells = [name, str(len(draws)), *cells, sd, f"{len(usable) / len(draws):.2f}", false]
        print("| " + " | ".join(cells) + " |", flush=True)


def report(draws: Sequence[Draw], by: Sequence[str]) -> None:
    """Print the table of all scenarios, and one of each by tilt, views or distance."""
    table("scenario", _grouped(draws, "scenario").items())
    for name, of in _grouped(draws, "scenario").items():
        for field in by:
            table(f"{name}, by {field}", _grouped(of, field).items())
    facing = [draw.focal_std / draw.prior_std for draw in draws if draw.tilt_deg == 0]
    facing = [ratio for ratio in facing if np.isfinite(ratio)]
    if facing:
        print(
            "\nBoards parallel to the image: reported sd of ln fx over what the prior leaves of it: "
            "smallest {:.2f}, 5 % below {:.2f}, median {:.2f}.".format(*np.percentile(facing, (0, 5, 50)))
        )


def _grouped(draws: Sequence[Draw], field: str) -> dict[str, list[Draw]]:
    groups: dict[str, list[Draw]] = {}
    for draw in draws:
        groups.setdefault(str(getattr(draw, field)), []).append(draw)
    return groups


def degeneracies(trials: int, pool: ProcessPoolExecutor) -> None:
    """Print recall and precision of each arrangement that the verdict names."""
    jobs = [(kind, number) for kind in ARRANGEMENTS for number in range(trials)]
    told = [named(reasons) for reasons in pool.map(reasons_for, jobs, chunksize=4)]
    true = [kind for kind, _ in jobs]
    print("\n| arrangement | n | so named (recall) | rightly so named (precision) |\n|---|---|---|---|")
    for kind in ARRANGEMENTS:
        says = np.array([kind in names for names in told])
        is_so = np.array([kind == other for other in true])
        recall, precision = (says & is_so).sum() / trials, (says & is_so).sum() / max(says.sum(), 1)
        print(f"| {kind} | {trials} | {recall:.3f} | {precision:.3f} |")


def save(draws: Sequence[Draw], folder: Path) -> None:
    """Write coverage.csv, one line a draw."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "coverage.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(field.name for field in fields(Draw))
        writer.writerows(astuple(draw) for draw in draws)


def plot(draws: Sequence[Draw], folder: Path) -> None:
    """Write coverage.png: shares over the tilt, one panel a quantity, one pair of lines a scenario."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(2, 4, figsize=(15, 7), sharex=True, sharey=True, layout="constrained")
    for axis, quantity in zip(axes.ravel(), QUANTITIES, strict=True):
        for goal, slack in ((0.68, 0.05), (0.95, 0.03)):
            axis.axhspan(goal - slack, goal + slack, color="0.9")
        for colour, (name, of) in enumerate(_grouped(draws, "scenario").items()):
            one, two, _ = zip(
                *(shares(cell, quantity) for cell in _grouped(of, "tilt_deg").values()), strict=True
            )
            axis.plot(TILTS_DEG, one, "--", color=f"C{colour}")
            axis.plot(TILTS_DEG, two, "-", color=f"C{colour}", label=name)
        axis.set(title=quantity, ylim=(0.3, 1.02))
    axes[0, 0].legend()
    figure.supxlabel("tilt of the board, degrees")
    figure.supylabel("truths within 1 (dashed) and 2 (solid) reported standard deviations")
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "coverage.png", dpi=80)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "--trials",
        type=int,
        default=8,
        help="a scenario and tilt; multiples of 8 balance the views (default 8)",
    )
    parser.add_argument("--scenarios", default=",".join(SCENARIOS), help="comma-separated, default all")
    parser.add_argument("--by", default="tilt_deg", help="of tilt_deg, views, distance (default tilt_deg)")
    parser.add_argument(
        "--arrangements", type=int, default=None, help="draws of each arrangement (default: --trials)"
    )
    parser.add_argument("--processes", type=int, default=None, help="default: one a core")
    parser.add_argument("--out", type=Path, help="folder for coverage.csv (default: it is not written)")
    parser.add_argument("--plots", type=Path, help="folder for the figure (default: none is drawn)")
    options = parser.parse_args()
    names = [name for name in options.scenarios.split(",") if name]
    jobs = list(product(names, TILTS_DEG, range(options.trials)))
    with ProcessPoolExecutor(options.processes) as pool:
        draws = list(pool.map(run, jobs, chunksize=8))
        report(draws, [field for field in options.by.split(",") if field])
        if options.out:
            save(draws, options.out)
        if options.plots:
            plot(draws, options.plots)
        count = options.trials if options.arrangements is None else options.arrangements
        if count:
            degeneracies(count, pool)


if __name__ == "__main__":
    main()
