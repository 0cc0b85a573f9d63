"""What commands print: progress, outcome, tables."""
