"""Recordings exported to CSV and Parquet tables."""
