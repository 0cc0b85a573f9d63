"""Campaigns: many trials of a scenario, over axes of its fields. What they import is the extra `lab`."""
