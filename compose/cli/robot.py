"""`tandem robot`: one robot in hardware mode: its driver in this process, its agent in another.

The other robots of the mission, its peer or all others of its group, run in the same way.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from compose.cli.participant import RELISTEN_S, participate, warn_beyond
from compose.errors import ENDED, status_of
from compose.hardware.driver_recording import recorded
from compose.launch.driver_loader import hardware_robot
from compose.launch.planner_loader import is_shipped
from compose.launch.processes import free_endpoint
from compose.launch.signals import stop_by_signal
from compose.launch.supervisor import STOP_S, ChildFailed, Supervisor
from compose.network import reach
from compose.recording.reasons import ended
from compose.recording.recording_files import folder_for
from compose.terminal.text_width import tell
from protocol.messages import Localised, MissionEnd, RobotConfig
from protocol.motion import wrap
from protocol.network import access_control, session
from protocol.network.clock import Clock
from protocol.network.endpoints import Endpoints
from protocol.network.inbox import Inbox
from protocol.output import say
from world.hardware.bridge import Field, NoStart

LEAST_S = 0.1
"""The least time between two starts of an agent (s): one that ends at once must not load the machine."""


def main(options: argparse.Namespace) -> int:
    """Run one robot's hardware and its agent to the end of the mission; resume a recording in --out."""
    scenario, config, rate, manoeuvre_s, error, made = hardware_robot(options, options.id)
    began = time.monotonic()
    reached = reach(options, "world")

    def take_part(inbox: Inbox) -> int:
        warn_beyond(reached, inbox)
        with (
            folder_for(options.out) as folder,
            recorded(folder, config, inbox, fsync=options.fsync) as recording,
            closing(made()) as driver,
        ):
            field = Field(
                driver,
                config,
                options.run or scenario.name,
                inbox,
                max_ticks=scenario.max_ticks,
                manoeuvre_s=manoeuvre_s,
                timeout=options.timeout,
                journal=recording.journal,
            )
            recording.take_up(driver, options.driver, field)
            told = error.arguments(began) if error is not None else []
            end = _run(options, field, config, reached, folder, inbox, told)
        if not options.quiet and isinstance(field.verdict, Localised):
            pose = field.verdict.pose
            say(f"{options.id}: claims {pose.x:.9f} {pose.y:.9f} {wrap(pose.heading):+.9f} (m, m, rad)")
        if not options.quiet:
            advice = f"; a lower --rate, such as {rate / 2:g}, leaves more time" if field.missed else ""
            missed = f"missed the deadline in {field.missed} of {end.tick + 1} ticks"
            tell(f"{options.id}: {missed}{advice}")
        tell(f"{options.id}: {ended(end, end.tick)}")
        return status_of(end.outcome)

    return participate(
        f"tandem robot {options.id}", take_part, (NoStart, ChildFailed), clock=Clock(error, began)
    )


def _run(
    options: argparse.Namespace,
    field: Field,
    config: RobotConfig,
    reached: Endpoints,
    folder: Path,
    inbox: Inbox,
    clock: Sequence[str],
) -> MissionEnd:
    """Run the mission with an agent process of its own, which is told `clock`, and return its end."""
    keys = (
        ["--keys", str(options.keys.resolve().parent / access_control.agent(options.id))]
        if options.keys
        else []
    )
    own = free_endpoint("tls" if keys else "tcp")
    endpoints = Endpoints(reached.connect, (own, *reached.listen), reached.settings, reached.folder)
    with session.open_router(endpoints, RELISTEN_S, closes=False) as link:  # the robots end at once
        children = Supervisor(inbox)
        agent = f"agent {options.id}"
        arguments = [
            *("agent", options.id, "--connect", own, "--launched", "--run", field.run, *keys),
            *("--out", str(folder.resolve()), "--timeout", str(options.timeout)),
            *(["--fsync"] if options.fsync else []),
            *clock,
            *([] if is_shipped(config.planner_name) else ["--planner", config.planner_name]),
        ]
        children.start(agent, *arguments)
        try:
            stop_by_signal(inbox)
            field.attach(link)
            if not options.quiet:
                whom = "the others" if config.members else "its peer"
                where = f"resumed at tick {field.tick}" if field.tick >= 0 else f"waiting for {whom}"
                say(f"{options.id}: in run {field.run}, {where}")
            end = field.run_mission(
                options.connect_timeout, lambda: _restart(children, agent, arguments, inbox)
            )
            children.wait(STOP_S)
        finally:
            children.stop()
            children.say_errors()
        return end


def _restart(children: Supervisor, agent: str, arguments: Sequence[str], inbox: Inbox) -> None:
    """Restart the agent if a signal has killed it; it resumes from its journal.

    Raises ChildFailed if it ended with an error.
    """
    status = children[agent].status
    if status == ENDED:
        return
    if status is None or status > 0:
        raise children.failure(agent)
    inbox.say(f"{agent} was killed by signal {-status} and is restarted")
    time.sleep(max(0.0, children[agent].started + LEAST_S - time.monotonic()))
    children.start(agent, *arguments)
