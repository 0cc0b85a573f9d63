"""Runs in Foxglove's formats: MCAP files, and a layout for them."""
