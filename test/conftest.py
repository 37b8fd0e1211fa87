from __future__ import annotations

import os
import sys
from pathlib import Path

from hypothesis import settings

# Tests that run at the same time would share the threads of the linear algebra, which changes the rounding.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# A busy machine makes any example slow now and then; that says nothing about the code.
settings.register_profile("fewcal", settings(), deadline=None)
settings.load_profile("fewcal")

# Last, so that experiments/coverage.py does not stand in for the package of that name.
sys.path.append(str(Path(__file__).resolve().parent.parent / "experiments"))
