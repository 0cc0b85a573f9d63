"""The exit statuses of all commands, and the exceptions that stand for a user's mistake."""

from __future__ import annotations

import errno
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from protocol.spelling import did_you_mean

if TYPE_CHECKING:
    from protocol.messages import Outcome

LOCALISED = 0
"""The exit status of a mission in which every robot was localised."""
ENDED = 0
"""The exit status of a completed command, of a check that found nothing wrong, and of a launched process."""
NOT_LOCALISED = 1
"""The exit status of a mission that ended with another outcome than `localised` or `failed`."""
VIOLATED = 1
"""The exit status of a check that found something wrong: an audit, a replay, a driver, or the doctor."""
USER_ERROR = 2
"""The exit status of every command that was refused because of a user's mistake."""
FAILED = 3
"""The exit status of a run that failed: a process was lost, or a file could not be read or written."""
BUG = 70
"""The exit status of a command that ended with an unexpected exception; its traceback is printed."""
BROKEN_PIPE = 141
"""The exit status of a command whose output was closed by its reader."""
STOPPED_STATUS = 130
"""The exit status of a command that was stopped by Ctrl-C or an equivalent signal."""
FULL_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""The errors of writing for which nothing is wrong with the path."""


class UserError(Exception):
    """A user's mistake; its text is one line that names the file or the flag, and what is wrong there."""

    exit_status = USER_ERROR
    """The exit status of the command that raises it."""


class CannotWrite(UserError):
    """A file or a folder cannot be written. The exit status is FAILED if the disk is full."""

    def __init__(self, place: object, error: OSError) -> None:
        """`place` is its path, with the flag that gave it if there is one."""
        super().__init__(f"{place} cannot be written: {error.strerror or error}")
        if error.errno in FULL_DISK:
            self.exit_status = FAILED


@contextmanager
def writing(place: object) -> Iterator[None]:
    """Raise an OSError in this context as CannotWrite, for `place`."""
    try:
        yield
    except OSError as error:
        raise CannotWrite(place, error) from None


@contextmanager
def within(where: str, kind: type[UserError]) -> Iterator[None]:
    """Raise a UserError of this context as a `kind` of error, whose text has `where` in front."""
    try:
        yield
    except UserError as error:
        raise kind(f"{where}{error}") from None


@contextmanager
def user_code(what: str, exit_status: int = USER_ERROR) -> Iterator[None]:
    """Raise whatever code of the user raises in this context as a UserError that begins with `what`."""
    try:
        yield
    except (Exception, SystemExit) as error:  # it may raise anything
        failed = UserError(f"{what} {type(error).__name__}: {error}")
        failed.exit_status = exit_status
        raise failed from error


# --- scenarios --------------------------------------------------------------------------------------


class NotToml(UserError):
    """A file is not valid TOML; the text names the file and the line."""


class BadScenario(UserError):
    """A scenario is invalid; the text names the file, the field and what is wrong."""


class Unworkable(BadScenario):
    """A scenario is well-formed, but no mission is feasible with its parameters; the text says why."""


class BadFault(UserError):
    """A fault of the radio is invalid; the text names the field and what is wrong."""


class BadKill(UserError):
    """A `--kill` or a `[[kill]]` table is invalid; the text shows the expected form or names the field."""


# --- planners ---------------------------------------------------------------------------------------


class PlannerFailed(UserError):
    """A planner of the user raised an error or gave an invalid answer; the text names the method and tick."""

    exit_status = FAILED


# --- sweeps -----------------------------------------------------------------------------------------


class BadSpec(UserError):
    """A sweep file is invalid; the text names the file, the field and what is wrong."""


class NoSuchField(UserError):
    """A field path of a sweep does not exist in the scenario; the text names the part that is missing."""


# --- range recordings -------------------------------------------------------------------------------


class BadRecording(UserError):
    """A range recording is invalid; the text names the file, the line and what is wrong."""


class NoEstimate(UserError):
    """The numbers of a valid recording allow no estimate; the text names the recording and the time."""

    exit_status = NOT_LOCALISED


def no_such(word: str, words: Collection[str], hint: str = "", what: str = "") -> str:
    """Return the sentence for a `word` that is not one of `words`, with what there is.

    It ends with the nearest word, or with `hint` if none is near. `what` is the noun before the word.
    """
    there = f"there is no {what}'{word}'; there are {', '.join(words)}"
    return there + (did_you_mean(word, words) or hint)


def status_of(outcome: Outcome) -> int:
    """Return the exit status of a command whose mission ended with `outcome`."""
    match outcome:
        case "localised":
            return LOCALISED
        case "failed":
            return FAILED
        case _:
            return NOT_LOCALISED
