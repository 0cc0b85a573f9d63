"""How a command ends."""

LOCALISED = 0
NOT_LOCALISED = 1
"""the mission came to its end, otherwise"""
USER_ERROR = 2
FAILED = 3
"""the run itself was lost"""
STOPPED = 130
"""by Ctrl-C, or a signal to the same effect"""


class UserError(Exception):
    """A mistake of the user's; its text is one line that names what and where."""
