"""`tandem agent`: one robot of a mission whose world is somewhere else."""

from __future__ import annotations

import argparse

from agent.process import AgentProcess, NoWorld, Search, Unwelcome, join
from compose.record import ended, make
from compose.status import ENDED, FAILED, STOPPED, UserError, status_of
from compose.stop import stop_by_signal, stop_with_launcher
from protocol import session
from protocol.inbox import Inbox, Interrupted
from protocol.journal import CannotRecord
from protocol.messages import End


def main(options: argparse.Namespace) -> int:
    """Play one robot's part."""
    inbox = Inbox(f"tandem agent {options.id}")
    if options.launched:
        stop_with_launcher(inbox)
    stop_by_signal(inbox)
    try:
        end = _play(options, inbox)
    except session.BadEndpoint as error:
        raise UserError(f"--connect: {error}") from None
    except CannotRecord as error:
        raise UserError(f"--out: {error}") from None
    except Unwelcome as error:
        raise UserError(str(error)) from None
    except NoWorld as error:
        inbox.say(str(error))
        return FAILED
    except Interrupted as signal_name:
        inbox.say(f"stopped by {signal_name}")
        return STOPPED
    if options.launched:
        return ENDED
    print(f"{options.id}: {ended(end.outcome, end.tick, end.reason)}")
    return status_of(end.outcome)


def _play(options: argparse.Namespace, inbox: Inbox) -> End:
    which = f"world of run '{options.run}'" if options.run else "world"
    search = Search(f"{which} at {options.connect}", options.wait, inbox)
    while True:
        with session.open_client(options.connect, search.go_on) as link:
            joined = join(link, options.run, options.id, search)
            if joined is None:  # a session that has lost its link finds nothing; a new one may
                continue
            run, briefing = joined
            if options.out is not None:
                make(options.out)
            process = AgentProcess(
                briefing, link, run, inbox, out=options.out, fsync=options.fsync, patience=options.patience
            )
            if not (options.quiet or options.launched):
                print(f"{options.id}: in run {run}, with {briefing.peer}", flush=True)
            return process.play()
