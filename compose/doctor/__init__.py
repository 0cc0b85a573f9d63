"""What a mission needs of a machine, its keys and its network: one check a module."""
