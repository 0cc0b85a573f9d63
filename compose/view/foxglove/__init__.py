"""Runs in Foxglove's formats: MCAP files and a live server."""
