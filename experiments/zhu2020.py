"""Reproduce the synthetic study of Zhu et al. (2020), figures 5 to 10 and 12, with map, zhu2020 and zhang.

    python experiments/zhu2020.py [--every 1] [--cases one two quantised figure12] [--plots DIR]

1350 trials each (sections 5.1.2 to 5.1.4 and 6); `--every 9` runs each ninth. Printed as markdown: successes
beside those of the paper, focal error and run time; for rounded pixels the focal error over the Cramer-Rao
bound; and mean and standard deviation of the bias of each parameter. `--plots` draws the paper's figures,
which needs matplotlib. The paper does not publish its poses; fewcal.virtual_camera says how ours are made.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

# One thread a process: the matrices are small, and the processes share the cores.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from paper_trials import CASES, SOLVERS, Case, Job, Outcome, run
from scipy.special import ndtr

from fewcal.virtual_camera import PAPER_COLUMNS

PRINTED = {
    ("one", "zhang"): (126, None),
    ("one", "zhu2020"): (608, None),
    ("two", "zhang"): (567, (22.0, 21.5)),
    ("two", "zhu2020"): (1350, (181.7, 73.0)),
    ("quantised", "zhang"): (540, (28.7, 21.3)),
    ("quantised", "zhu2020"): (1350, (192.5, 78.4)),
}
"""What the paper prints: successes of 1350; mean and standard deviation of the run time, ms (its laptop)."""

SUCCESS_COLUMNS = (
    "method",
    "successes",
    "printed",
    "no answer",
    "focal error, median / 90 % / largest",
    "one trial alone, mean (sd), ms",
    "printed",
    "trials a second in a batch, one core",
    "printed",
)


def by_method(outcomes: Sequence[Outcome]) -> dict[str, list[Outcome]]:
    """Sort outcomes."""
    sorted_out: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        sorted_out.setdefault(outcome.method, []).append(outcome)
    return sorted_out


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print markdown."""
    for row in (header, ["---"] * len(header), *rows):
        print("| " + " | ".join(row) + " |")
    print(flush=True)


def successes(name: str, outcomes: Sequence[Outcome]) -> None:
    """Print how many trials succeed, the focal error and the run time."""
    rows = []
    for method, of in by_method(outcomes).items():
        printed, spent = PRINTED.get((name, method), (None, None))
        errors = np.percentile([outcome.focal_error for outcome in of], (50, 90, 100), method="lower")
        ms = 1e3 * np.array([outcome.alone for outcome in of if outcome.alone > 0])
        rows.append(
            [
                method,
                f"{sum(outcome.success for outcome in of)} of {len(of)}",
                "-" if printed is None else f"{printed} of 1350",
                str(sum(np.isinf(outcome.focal_error) for outcome in of)),
                " / ".join("-" if np.isinf(error) else f"{100 * error:.2g} %" for error in errors),
                f"{ms.mean():.1f} ({ms.std():.1f})",
                "-" if spent is None else "{:.1f} ({:.1f})".format(*spent),
                f"{1 / np.mean([outcome.seconds for outcome in of]):.0f}",
                "-" if spent is None else f"{1e3 / spent[0]:.0f}",
            ]
        )
    print(f"## {CASES[name].title}\n")
    table(SUCCESS_COLUMNS, rows)


def efficiency(case: Case, outcomes: Sequence[Outcome]) -> None:
    """Print the focal error over the Cramer-Rao bound."""
    if not case.quantised:
        print("Exact points have no Cramer-Rao bound: all of the focal error is rounding, or failure.\n")
        return
    print(
        "Relative focal error over the Cramer-Rao bound for an error of 1 / sqrt(12) px: medians over trials "
        "with an answer, which are 0.67 for an efficient estimator; below, the number of trials whose focal "
        "length an estimator at that bound has within 30 %.\n"
    )
    rows = []
    for method, of in by_method(outcomes).items():
        ratios = [outcome.focal_error / outcome.bounds for outcome in of if np.isfinite(outcome.focal_error)]
        if ratios:
            rows.append([method, *(f"{ratio:.2f}" for ratio in np.median(ratios, axis=0))])
    trials = next(iter(by_method(outcomes).values()))
    bounds = np.array([outcome.bounds for outcome in trials])
    within = (ndtr(np.log(1.3) / bounds) - ndtr(np.log(0.7) / bounds)).sum(axis=0)
    rows.append(["possible", *(f"{count:.0f} of {len(bounds)}" for count in within)])
    table(["method", "points alone", "with the priors of map but that of f", "with all its priors"], rows)


def biases(case: Case, outcomes: Sequence[Outcome]) -> None:
    """Print mean and standard deviation of the bias of each parameter over successful trials."""
    groups = {
        method: np.array([outcome.bias for outcome in of if outcome.success])
        for method, of in by_method(outcomes).items()
    }
    print("Bias over successful trials, mean (sd): pixels, px^-2, px^-4, rad, metres.\n")
    rows = [
        [name] + [f"{b[:, i].mean():.1e} ({b[:, i].std():.1e})" if len(b) else "-" for b in groups.values()]
        for i, name in enumerate(case.parameters)
    ]
    table(["parameter", *groups], rows)


def outcomes_of(
    pool: ProcessPoolExecutor, name: str, every: int = 1, methods: tuple[str, ...] = ()
) -> list[Outcome]:
    """Run one case, with its own methods or others."""
    methods = methods or CASES[name].methods
    # The largest boards first, so that no process is left alone with one at the end.
    jobs = [Job(name, columns, methods, every) for columns in reversed(PAPER_COLUMNS)]
    return [outcome for some in reversed(list(pool.map(run, jobs))) for outcome in some]


def main() -> None:
    """Print the tables and draw the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--every", type=int, default=1, help="run each n-th trial (default all)")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES), help="default: all")
    parser.add_argument(
        "--methods", nargs="+", choices=SOLVERS, default=(), help="default: as suits the case"
    )
    parser.add_argument("--processes", type=int, default=os.cpu_count(), help="default: one a core")
    parser.add_argument("--plots", type=Path, help="folder for the figures (default: none are drawn)")
    options = parser.parse_args()
    with ProcessPoolExecutor(options.processes) as pool:
        for name in options.cases:
            outcomes = outcomes_of(pool, name, options.every, tuple(options.methods))
            successes(name, outcomes)
            efficiency(CASES[name], outcomes)
            biases(CASES[name], outcomes)
            if options.plots:
                from paper_figures import draw

                draw(name, outcomes, options.plots)


if __name__ == "__main__":
    main()
