"""The simulator: true poses, sensors, the radio channel, and the process that runs them."""
