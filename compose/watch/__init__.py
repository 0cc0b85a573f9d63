"""The page on which a run is watched, live or again: what it shows, and who serves it."""
