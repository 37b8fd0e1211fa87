"""Calibrate from a bundled recording and print the result beside the truth it was rendered with.

    python experiments/demo.py [RECORDING]

RECORDING is a name in bags/truth.json, by default the first. Results go to demo_output/. Exits with 0 when
the calibration is usable and its focal length lies within three reported standard deviations of the truth.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).resolve().parent.parent
BAGS, OUTPUT = ROOT / "bags", ROOT / "demo_output"
TOLERATED = 3.0
"""Largest distance from the truth, reported standard deviations: 1 in 370 if the error bars are honest."""
DISTORTION = ("k1", "k2", "p1", "p2")
"""The coefficients that are estimated with an error bar, in the order of plumb_bob."""


def main(names: list[str]) -> int:
    """Run the command on one recording and compare; returns the exit code."""
    recordings: dict[str, Any] = json.loads((BAGS / "truth.json").read_text())
    name = names[0] if names else next(iter(recordings))
    if name not in recordings:
        print(f"There is no recording {name!r}; choose from {', '.join(recordings)}.", file=sys.stderr)
        return 2
    truth = recordings[name]
    command = ["fewcal", "calibrate", f"bags/{name}", "--board", truth["board"], "--out", OUTPUT.name]
    print("$", *command, flush=True)
    (OUTPUT / "calibration.json").unlink(missing_ok=True)  # no earlier result may pass for this one
    # The command of the very environment that runs this script, whatever the shell's PATH says.
    status = subprocess.run([Path(sys.executable).with_name("fewcal"), *command[1:]], cwd=ROOT, check=False)
    if not (OUTPUT / "calibration.json").exists():
        return status.returncode
    result = json.loads((OUTPUT / "calibration.json").read_text())
    print_beside(result, truth["camera"], name)
    error = abs(result["camera"]["fx"] - truth["camera"]["fx"])
    return status.returncode or int(error > TOLERATED * result["std"]["fx"])


def print_beside(result: dict[str, Any], truth: dict[str, Any], name: str) -> None:
    """Print each parameter, its error bar, the truth, and how many error bars lie between."""
    table = Table("parameter", "calibrated", "one sigma", "truth", "sigmas apart", title=f"\n{name}")
    for column in table.columns[1:]:
        column.justify = "right"
    found, known = values_of(result["camera"]), values_of(truth)
    for parameter, value in found.items():
        sigma, true = result["std"][parameter], known[parameter]
        digits = 5 if parameter in DISTORTION else 2
        numbers = [f"{number:.{digits}f}" for number in (value, sigma, true)]
        table.add_row(parameter, *numbers, f"{(value - true) / sigma:+.1f}")
    Console().print(table)
    print(f"The recording and {OUTPUT.name}/camera.yaml are yours to look at; the verdict is above.")


def values_of(camera: dict[str, Any]) -> dict[str, float]:
    """Parameters of a camera by name, in the order of the report."""
    pinhole = {key: float(camera[key]) for key in ("fx", "fy", "cx", "cy")}
    return pinhole | dict(zip(DISTORTION, camera["distortion"], strict=False))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
