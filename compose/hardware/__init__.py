"""Recordings of hardware mode and the driver conformance check."""
