"""The page on which runs are watched, and its server."""
