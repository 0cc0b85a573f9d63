"""One robot's mind, and the process that it runs in."""
