"""The recording of a run and the files derived from it."""
