"""Sweeps: many trials of a scenario over axes of its fields."""

SWEEP_JSON = "sweep.json"
"""The name of the manifest."""
SUMMARY_CSV = "summary.csv"
"""The name of the table of cells."""
PARTS = "parts"
"""The folder of the parts of `trials.parquet`, until a sweep is complete."""
MOST_WORKERS = 1000
"""The largest number of worker processes."""
