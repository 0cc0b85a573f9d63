"""The part that the participants of a mission share: `tandem world`, `tandem agent` and `tandem robot`."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from signal import SIGKILL

from compose.errors import FAILED, STOPPED_STATUS, UserError
from compose.launch.signals import stop_with_launcher
from compose.network import beyond, reach
from compose.recording.recording_files import not_recorded
from protocol.journal.journal_file import CannotRecord, CorruptJournal, OtherVersion
from protocol.journal.resume import Retrace
from protocol.network import session
from protocol.network.clock import Clock
from protocol.network.endpoints import Endpoints
from protocol.network.inbox import Inbox, Interrupted
from protocol.network.watchdog import watch

RELISTEN_S = 5.0
"""s to wait for the port of a participant that has just been killed to become free."""


def participate(
    owner: str,
    body: Callable[[Inbox], int],
    failures: tuple[type[Exception], ...],
    *,
    launched: bool = False,
    clock: Clock | None = None,
) -> int:
    """Return the exit status of `body`, which gets an inbox; `owner` begins its messages.

    The inbox has `clock`. `body` must call `stop_by_signal` before it runs the mission; until then, a signal
    raises an exception. A process that is `launched` also stops with its launcher. An exception of `failures`
    is printed, and the status is FAILED; after a signal it is STOPPED_STATUS. Raises UserError if a flag
    cannot be followed.

    If Zenoh does not return from a call, the process ends: one that is `launched` as if it had been killed,
    from which its launcher restarts a robot's agent.
    """
    inbox = Inbox(owner, clock)
    if launched:
        stop_with_launcher(inbox)
    watch(owner, partial(os.kill, os.getpid(), SIGKILL) if launched else partial(os._exit, FAILED))
    try:
        return body(inbox)
    except session.CannotListen as error:
        raise UserError(f"--listen: {error}") from None
    except CannotRecord as error:
        raise not_recorded(error) from None
    except OtherVersion as error:
        raise UserError(f"--out: {error.path}: {error.versions}; choose another folder") from None
    except CorruptJournal as error:
        raise UserError(f"--out: {error}; choose another folder") from None
    except Interrupted as signal_name:
        inbox.say(f"stopped by {signal_name}")
        return STOPPED_STATUS
    except failures as error:
        inbox.say(str(error))
        return FAILED


def endpoints_of(options: argparse.Namespace, keys: str, missing: str) -> Endpoints:
    """Return the endpoints of the flags, with the certificates of `keys`. Raises UserError if there are none.

    `missing` is the text of that error.
    """
    found = reach(options, keys)
    if not found.connect and not found.listen:
        raise UserError(missing)
    return found


def warn_beyond(endpoints: Endpoints, inbox: Inbox) -> None:
    """Print a warning if other machines can connect to `endpoints` without authentication."""
    if (warning := beyond(endpoints)) is not None:
        inbox.say(warning)


def replayed(ticks: int) -> str:
    """Return the message of a restarted process whose decisions in `ticks` ticks equal its journal."""
    return f"back, replayed {ticks} tick{'' if ticks == 1 else 's'}, identical"


def old_journal(options: argparse.Namespace, name: str) -> Retrace | None:
    """Return the journal `name` of an earlier process in --out, if there is one."""
    path: Path | None = options.out / name if options.out is not None else None
    return Retrace(path, fsync=options.fsync) if path is not None and path.exists() else None
