from __future__ import annotations

import os
import sys
from pathlib import Path

from hypothesis import settings

from fewcal_ros.threads import SINGLE_THREAD

# As the commands do it, with which results are compared to the last bit.
os.environ.setdefault(*SINGLE_THREAD)

# A busy machine makes any example slow now and then; that says nothing about the code.
settings.register_profile("fewcal", settings(), deadline=None)
settings.load_profile("fewcal")

# Last, so that experiments/coverage.py does not stand in for the package of that name.
sys.path.append(str(Path(__file__).resolve().parent.parent / "experiments"))
