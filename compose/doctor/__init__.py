"""Checks of a machine, its keys and its network, and the list of running missions."""
