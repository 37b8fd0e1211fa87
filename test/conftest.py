from __future__ import annotations

import sys
from pathlib import Path

from hypothesis import settings

# A busy machine makes any example slow now and then; that says nothing about the code.
settings.register_profile("fewcal", settings(), deadline=None)
settings.load_profile("fewcal")

# Last, so that experiments/coverage.py does not stand in for the package of that name.
sys.path.append(str(Path(__file__).resolve().parent.parent / "experiments"))
