"""The terminal output of commands: progress, outcome and tables."""
