"""The start of missions, in one process or as several, with viewers and signals."""
