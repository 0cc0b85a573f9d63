"""How a command ends."""

from protocol.messages import Outcome

LOCALISED = 0
ENDED = 0
"""of a process that `tandem run` launched: its mission came to an MissionEnd, whichever"""
NOT_LOCALISED = 1
"""the mission came to its end, otherwise"""
CLEAN = 0
"""of an audit: nothing was found"""
VIOLATED = 1
"""something was"""
AMISS = 1
"""a check of `tandem doctor` failed"""
USER_ERROR = 2
FAILED = 3
"""the run itself was lost"""
BUG = 70
"""an error of ours, with its traceback"""
BROKEN_PIPE = 141
"""whoever read the output has gone"""
STOPPED = 130
"""by Ctrl-C, or a signal to the same effect"""


class UserError(Exception):
    """A mistake of the user's; its text is one line that names what and where."""


def status_of(outcome: Outcome) -> int:
    """The exit status of a command whose mission ended so."""
    match outcome:
        case "localised":
            return LOCALISED
        case "failed":
            return FAILED
        case _:
            return NOT_LOCALISED
