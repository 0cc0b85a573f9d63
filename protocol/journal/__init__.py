"""The journal of a process: its file, its environment and how a restarted process resumes it."""
