"""The definitions that all processes share: messages, units, mission parameters, journals and the network."""

PACKAGE = "tandem-ranging"
"""The name of the distribution of Tandem."""
