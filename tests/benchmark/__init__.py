"""Measurements of speed, each beside a baseline measured in the same run.

    uv run python -m tests.benchmark [--rounds N]

Absolute times depend on the machine and its load; ratios depend on them much less. All measurements are
interleaved (A B A B), and their medians are compared.
"""
