"""Exports of recordings: MCAP, CSV and Parquet files."""
