from __future__ import annotations

from hypothesis import settings

# A busy machine makes any example slow now and then; that says nothing about the code.
settings.register_profile("fewcal", settings(), deadline=None)
settings.load_profile("fewcal")
