"""Hardware mode: a robot's driver in place of the simulator."""
