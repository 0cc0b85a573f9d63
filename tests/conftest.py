from __future__ import annotations

from hypothesis import settings

settings.register_profile("tandem", derandomize=True, deadline=None, database=None)
settings.load_profile("tandem")
