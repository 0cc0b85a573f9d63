"""Starting missions: in one process, or as processes with their viewers and signals."""
