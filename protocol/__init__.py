"""The definitions that all processes share: messages, units, mission parameters, journals and the network."""
