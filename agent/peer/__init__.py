"""A robot's knowledge of its peer: motion logs, acknowledgements and, for experiments, false reports."""
