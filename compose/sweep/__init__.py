"""Sweeps: many trials of a scenario over axes of its fields."""
