"""Checks of a machine, its keys and its network, and a list of running missions."""
