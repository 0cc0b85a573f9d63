"""Expected results of the shipped sweeps, one file each, and the command that compares a run with them."""
