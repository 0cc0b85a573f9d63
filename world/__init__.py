"""What is true, and the process that owns it."""
