"""`tandem agent`: run the agent of one robot; it connects to a world."""

from __future__ import annotations

import argparse

from agent.process.discovery import NoWorld, Search, Unwelcome
from agent.process.node import AgentProcess, run_agent
from agent.process.recovery import Memory, remember
from agent.process.robot import Robot
from compose.cli.participant import endpoints_of, old_journal, participate, replayed, warn_beyond
from compose.errors import ENDED, UserError, status_of
from compose.launch import planner_loader
from compose.launch.signals import stop_by_signal
from compose.recording.reasons import ended
from compose.recording.recording_files import agent_journal
from compose.scenario import kills
from compose.terminal.outcome import reopened
from compose.terminal.text_width import tell
from protocol.journal.journal_file import CorruptJournal, Journal
from protocol.journal.resume import Retrace
from protocol.messages import MissionEnd, RobotConfig
from protocol.network.inbox import Inbox
from protocol.output import leave, say

CONNECT_MISSING = "--connect ENDPOINT is required, such as tcp/127.0.0.1:7447"
ENDED_SEARCH_S = 3.0
"""s for which an agent that resumes after its MissionEnd looks for a world that may lack its FinalReport."""
ENDED_TIMEOUT_S = 10.0
"""s for which that agent then waits for a message of the world."""


def main(options: argparse.Namespace) -> int:
    """Run the agent to the end of its mission, and return the exit status of the outcome."""

    def take_part(inbox: Inbox) -> int:
        try:
            end = _run(options, inbox)
        except Unwelcome as error:
            raise UserError(str(error)) from None
        if options.launched:
            return ENDED
        tell(f"{options.id}: {ended(end, end.tick)}")
        return status_of(end.outcome)

    return participate(
        f"tandem agent {options.id}", take_part, (NoWorld,), launched=options.launched, clock=options.clock
    )


def _run(options: argparse.Namespace, inbox: Inbox) -> MissionEnd:
    """Run the agent, resumed from its journal if there is one, and return the MissionEnd."""
    endpoints = endpoints_of(options, f"agent-{options.id}", CONNECT_MISSING)
    old = old_journal(options, agent_journal(options.id))
    memory = remember(old, planner_loader.planner_of) if old is not None else None
    end = memory.end if memory is not None else None
    which = f"world of run '{options.run}'" if options.run else "world"
    wait = options.connect_timeout if end is None else min(options.connect_timeout, ENDED_SEARCH_S)
    timeout = options.timeout if end is None else min(options.timeout, ENDED_TIMEOUT_S)

    def start(run: str, config: RobotConfig) -> AgentProcess:
        name = config.planner_name
        if not planner_loader.is_shipped(name) and name not in options.planner:
            raise Unwelcome(
                f"run '{run}' uses the planner '{name}', which this command does not name; if you trust "
                f"its code on this machine, add --planner {name}"
            )
        if memory is not None and old is not None and memory.robot.config != config:
            raise CorruptJournal(
                f"{old.path}: belongs to another run: its configuration does not match the world's"
            )
        ready = _ready(options, config, old, memory, inbox)
        return AgentProcess(
            ready,
            run,
            inbox,
            timeout=timeout,
            launched=options.launched,
            on_kill_point=kills.taker(options.kill),
        )

    def announce(run: str, config: RobotConfig) -> None:
        observation = memory.observation if memory is not None else None
        if options.launched and memory is not None:
            inbox.say(replayed(observation.tick + 1 if observation is not None else 0))
        elif not (options.quiet or options.launched):
            where = f", resumed at tick {observation.tick}" if observation is not None else ""
            others = (config.peer,) if config.team is None else config.others
            company = f"with {', '.join(others)}" if others else "alone"
            say(f"{options.id}: in run {run}, {company}{where}")

    def leave_at_once() -> None:
        # The world has received everything. A launched process ends here, because closing the links of
        # many robots that end at the same time takes a while.
        if options.launched:
            leave(ENDED)

    stop_by_signal(inbox)
    return run_agent(
        options.id,
        options.run,
        endpoints,
        Search(which, endpoints, wait, inbox),
        start=start,
        on_first_link=lambda: warn_beyond(endpoints, inbox),
        on_joined=announce,
        on_end=leave_at_once,
        end=end,
    )


def _ready(
    options: argparse.Namespace, config: RobotConfig, old: Retrace | None, memory: Memory | None, inbox: Inbox
) -> Memory:
    """Return the state of a new or resumed robot, with its journal open. Raises CannotRecord."""
    journal: Journal | None = None
    if old is not None:
        journal = reopened(old, inbox)
    elif options.out is not None:
        journal = Journal(options.out / agent_journal(options.id), fsync=options.fsync)
    if memory is None:
        return Memory(Robot(config, planner_loader.planner_of(config), journal))
    memory.robot.append_to(journal)
    return memory
