"""The web page for watching runs, and its server."""
