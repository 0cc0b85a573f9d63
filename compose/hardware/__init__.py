"""Recordings of hardware mode, and the conformance check of drivers."""
