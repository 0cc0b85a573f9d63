"""The commands of `tandem` and their arguments: one table, from which parsers, help and completion follow.

Each line of arguments is `WORDS: HELP`, or only WORDS if the argument is hidden. WORDS are the flags and the
name of the value, or the field of the options and its name; a flag alone is a switch. One of MARKS may
follow, and the default after ` = `. A line that begins with `|` excludes the argument of the line before.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from compose.cli import arguments
from compose.cli.removed import another_scenario
from compose.figures import FIGURE_FORMATS, PICTURES
from compose.sweep import MOST_WORKERS

SHELLS = ("bash", "zsh")
"""The shells for which there is completion."""
VALUES: Mapping[str, Callable[[str], Any] | tuple[str, ...]] = {
    **dict.fromkeys(("file", "folder", "recording"), arguments.folder),
    **dict.fromkeys(("--anchors", "--config", "--keys", "--out"), arguments.folder),
    **dict.fromkeys(
        ("--accuracy", "--connect-timeout", "--minutes", "--rate", "--timeout"), arguments.positive
    ),
    **dict.fromkeys(("id", "--robot", "--run"), arguments.name),
    "others": another_scenario,
    "planners": arguments.planner,
    "scenario": arguments.source,
    "shell": SHELLS,
    "--address": arguments.address,
    "--confidence": arguments.confidence,
    "--days": arguments.up_to(36_500),
    "--format": FIGURE_FORMATS,
    "--clock": arguments.clock,
    "--jobs": arguments.up_to(MOST_WORKERS),
    "--kill": arguments.kill,
    "--model": arguments.model,
    "--only": PICTURES,
    "--option": arguments.option,
    "--planner": arguments.planner,
    "--planner-option": arguments.planner_option,
    "--port": arguments.port,
    "--print-trial": arguments.cell_and_trial,
    "--robots": arguments.names,
    "--scenario": arguments.source,
    "--runs": arguments.up_to(10**9),
    "--schema": ("scenario", "sweep"),
    "--seed": arguments.natural,
    "--trials": arguments.up_to(10**7),
    "--window": arguments.window,
    "--workers": arguments.up_to(MOST_WORKERS),
}
"""The functions that turn the texts of arguments into values, or their choices; all others are texts."""


MARKS: Mapping[str, Mapping[str, Any]] = {
    "!": {"required": True},
    "+": {"action": "append", "default": []},
    "*": {"nargs": "*", "default": []},
    "?": {"nargs": "?", "const": "scenario"},
}
"""The settings of arguments that are required, may be repeated, may be several, or need no value."""


class CommandEntry(NamedTuple):
    """One command of `tandem`."""

    name: str
    """The word on the command line."""
    group: str
    """The heading under which `tandem --help` lists it."""
    summary: str
    """One line that says what it does."""
    examples: str
    page: str
    """The page about it, in the repository."""
    arguments: str

    @property
    def module(self) -> str:
        """The module that defines its `main`."""
        return f"compose.cli.{self.name.replace('-', '_')}"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Add the arguments to `parser`, and end its help with examples and the page."""
        lines = [" ".join(line.split()) for line in self.arguments.splitlines() if line.strip()]
        to: argparse._ActionsContainer = parser
        for line, following in zip(lines, [*lines[1:], ""], strict=True):
            if not line.startswith("|"):
                to = parser.add_mutually_exclusive_group() if following.startswith("|") else parser
            words, _, text = line.removeprefix("| ").partition(": ")
            flags, settings = _settings(words)
            to.add_argument(*flags, help=text or argparse.SUPPRESS, **settings)
        parser.epilog = f"example:\n  {self.examples}\n\ndocumentation:\n  {self.page}"


def _settings(words: str) -> tuple[list[str], dict[str, Any]]:
    """Return the flags of an argument, and its other settings by their names in `argparse`."""
    words, _, default = words.partition(" = ")
    mark = words[-1] if words[-1] in MARKS else ""
    parts = words.removesuffix(mark).split()
    flags = [part for part in parts if part.startswith("-")] or parts[:1]
    flags[-1], switched, _ = flags[-1].partition("/")
    value = VALUES.get(flags[-1])
    named = {"metavar": parts[-1]} if len(parts) > len(flags) else {}
    settings: dict[str, Any] = named | dict(MARKS.get(mark, {}))
    if switched:
        settings |= {"action": argparse.BooleanOptionalAction, "default": default == "yes" or None}
    elif isinstance(value, tuple):
        settings |= {"choices": value}
    elif value is not None:
        settings |= {"type": value}
    elif flags[0].startswith("-") and not settings:
        settings = {"action": "store_true"}
    if default and not switched:
        settings["default"] = value(default) if callable(value) else default
    return flags, settings


# --- arguments of several commands ------------------------------------------------------------------

SCENARIO = """
    scenario SCENARIO: name of a scenario that ships with Tandem, or path of a TOML file
"""
SEED = """
    --seed N: seed of all random draws, 0 to 2^63 - 1 [default: the scenario's]
"""
CHANGED_SCENARIO = f"""{SCENARIO}{SEED}
    --fault FAULT+: fault of the radio, such as 'a->b: loss=0.3, delay=0..3' (delay in ticks); \
        may be repeated
    --planner NAME: planner to use instead of the scenario's: assured, paper, an installed one, \
        or MODULE:CLASS
    --planner-option NAME=VALUE+: option of a planner of your own; may be repeated
    --rate X: run in real time, X times as fast as simulated time [default: lockstep, as fast as possible]
"""
MODEL = """
    --model MODULE:CLASS+: range or radio model of your own that the recording uses, whose code this command \
        may run; may be repeated
"""
TRUSTED_PLANNER = """
    --planner NAME+: planner of your own whose code this command may run, MODULE:CLASS or an installed one; \
        may be repeated [default: only shipped planners]
"""
RECORDING = f"""
    recording DIR: folder of a recording, written with --out DIR
{MODEL}"""
RUNNING = """
    --out DIR: folder to which the recording is written [default: no recording is kept]
    --timeout S = 30: seconds without an answer before the run fails [default: %(default)g]
    -q --quiet: print only the outcome
"""
ENDPOINT = f"such as {arguments.ENDPOINT_EXAMPLE}; may be repeated"
CONNECTION = f"""
    --connect ENDPOINT+: router to connect to, {ENDPOINT}
    --keys DIR: encrypt with the certificates in DIR, one of the folders written by `tandem keys`
    | --config FILE: Zenoh configuration file to use instead
"""
PARTICIPATION = f"""{RUNNING}
    --run NAME: name of the run [default: {{run}}]
{CONNECTION}
    --listen ENDPOINT+: endpoint on which {{listen}}, {ENDPOINT}
    --fsync: flush every journal write to disk, so that it survives a power cut
"""
"""The arguments of every participant; `run` is the default name, and `listen` who listens."""
ROUTER = "this process is a Zenoh router"
DRIVER_OPTIONS = """
    --option NAME=VALUE+: option that is passed to the driver; may be repeated
    --rate X: run X times as fast as real time, with a driver that supports it [default: 1]
"""
LISTENING_TIME = """
    --timeout S = 2: seconds to listen to running missions [default: %(default)g]
"""
PAGE_PORT = """
    --port N: TCP port of the web page, 0 to 65535 [default: any free port]
"""
RANGES = "range recording: a .pyfg or .mcap file, a folder of CSV files, a recording of Tandem, or a .toml \
            file that maps the topics of a rosbag2"
PART_OF_RECORDING = """
    --anchors FILE: CSV file of anchors to add to the recording, or to move [default: none]
    --window S..S: use only these seconds, such as 10..40, from the first odometry on [default: all]
"""
LAUNCHED = """
    --launched
    --kill KILL+
    --clock CLOCK
"""
"""The flags of participants that another command launches."""


def _connect_timeout(target: str) -> str:
    """Return the flag for the wait for `target`."""
    return f"""
    --connect-timeout S = 60: seconds to wait for {target} before giving up [default: %(default)g]
"""


# --- commands ---------------------------------------------------------------------------------------

COMMANDS = (
    CommandEntry(
        *("run", "Run", "Run a mission on this machine."),
        *("tandem run paper-1 --out recording", "docs/tutorial-mission.md"),
        f"""{CHANGED_SCENARIO}
        others*
        {RUNNING}
        --in-process: run in one process, without network; decisions are the same
        --secure: encrypt all links, with certificates made for this run only
        --export/--no-export: also write run.mcap and tables to --out DIR [default: if the extra `lab` \
            is installed]
        --watch: serve a web page that shows the mission, live and afterwards
        {PAGE_PORT}
        --kill WHO@TICK+: kill a process in a tick and restart it, such as a@17, b@20:report or \
            world@30:journal+5s (after 5 s; +never: not); the points of a tick are observation, report, \
            journal, command; may be repeated
        """,
    ),
    CommandEntry(
        *("replay", "Run", "Run a recording again and compare it with the original bit by bit."),
        *("tandem replay recording", "docs/howto-audit.md"),
        f"{RECORDING}{TRUSTED_PLANNER}",
    ),
    CommandEntry(
        *("scenarios", "Run", "List the scenarios and sweeps that ship with Tandem."),
        *("tandem scenarios", "docs/howto-scenario.md"),
        """
        --schema?: print the JSON Schema of scenario or sweep files instead, for editors [default: scenario]
        """,
    ),
    CommandEntry(
        *("init", "Run", "Write a scenario, a sweep, a script and a driver to start from."),
        *("tandem init mine", "docs/howto-scenario.md"),
        "folder DIR: folder to which the files are written; none is replaced",
    ),
    CommandEntry(
        *("sweep", "Run", "Run many trials of a scenario, over ranges of its fields."),
        *("tandem sweep noise --trials 50 --out results", "docs/howto-sweep.md"),
        """
        spec SPEC: name of a sweep that ships with Tandem, or path of a TOML file
        --out DIR: folder for the results; an unfinished sweep in it is resumed [default: sweep-NAME]
        --trials N: trials per cell, 1 to 10^7 [default: the sweep's]
        --seed S: seed of all trials, 0 to 2^63 - 1 [default: the sweep's]
        --workers N: worker processes, 1 to 1000 [default: one per core]
        | --scheduler ADDRESS: address of a running Dask scheduler to use instead
        --processes: run each trial as processes over Zenoh [default: in one process]
        --audit/--no-audit = yes: audit the journals of every trial, which takes most of the time \
            [default: --audit]
        --retry: run failed trials of an earlier call again
        --print-trial [CELL:]N: print the scenario file of a trial and exit [default cell: 0]
        -q --quiet: print only the counts
        """,
    ),
    CommandEntry(
        *("arena", "Run", "Compare planners on the same missions."),
        *("tandem arena assured greedy mine:Own --trials 20 --out compared", "docs/own-planner.md"),
        """
        planners PLANNER*: planners to compare, the first of which is the reference: names, or MODULE:CLASS \
            [default: assured paper greedy fisher random]
        --scenario SCENARIO+: scenario of missions: a name or a TOML file; may be repeated [default: noisy]
        --out DIR: folder for table, figure and missions, of which those that are in it do not run again \
            [default: none are kept]
        --trials N: missions of each planner in each scenario, 1 to 10^7 [default: 50]
        --seed S: seed of all missions, 0 to 2^63 - 1 [default: 0]
        --workers N: worker processes, 1 to 1000 [default: one per core]
        -q --quiet: print only the table
        """,
    ),
    CommandEntry(
        *("hunt", "Run", "Search for faults with which a mission breaks an invariant."),
        *("tandem hunt random --minutes 5", "docs/howto-hunt.md"),
        f"""{SCENARIO}
        --minutes M = 5: wall time of the search in minutes [default: %(default)g]
        | --runs N: number of runs instead, in batches of 16, after which it ends
        --workers --jobs N: worker processes, 1 to 1000 [default: one per core]
        --seed N = 0: seed of all draws, 0 to 2^63 - 1 [default: %(default)s]
        --out FILE: scenario file that is written if something is found [default: hunt-SCENARIO.toml]
        -q --quiet: print only the results
        """,
    ),
    CommandEntry(
        *("world", "Deploy", "Run the simulator of a mission; agents connect to it."),
        *("tandem world paper-1 --listen tcp/127.0.0.1:7447 --out recording", "docs/network.md"),
        CHANGED_SCENARIO
        + PARTICIPATION.format(run="the scenario's and a random suffix", listen=ROUTER)
        + LAUNCHED,
    ),
    CommandEntry(
        *("agent", "Deploy", "Run the agent of one robot; it connects to a world."),
        *("tandem agent a --connect tcp/127.0.0.1:7447 --out recording-a", "docs/network.md"),
        f"""
        id ID: id of the robot in the scenario
        {PARTICIPATION.format(run="the only one that is running", listen=ROUTER)}
        {_connect_timeout("a world")}{TRUSTED_PLANNER}{LAUNCHED}""",
    ),
    CommandEntry(
        *("robot", "Deploy", "Run one robot on its own hardware, with its driver."),
        "tandem robot a --mission paper-1 --driver docs.rover:Rover --listen tcp/0.0.0.0:7447",
        "docs/driver.md",
        f"""
        id ID: id of this robot in the mission
        --driver MODULE:CLASS!: driver of the robot's wheels and sensors
        --mission FILE!: scenario of the mission: a name or a TOML file; start poses are not used
        {DRIVER_OPTIONS}
        {PARTICIPATION.format(run="the scenario's name", listen="other robots can reach this one")}
        {_connect_timeout("the other robots")}""",
    ),
    CommandEntry(
        *("keys", "Deploy", "Create certificates and access rules for networks without trust."),
        *("tandem keys keys --robots a,b --host 10.0.0.1", "docs/network.md"),
        """
        folder DIR: folder for the keys, one subfolder per participant; existing keys are not replaced
        --robots A,B!: ids of the robots that take part
        --host NAME+: host name or IP address of the world or a router; may be repeated \
            [always included: localhost, 127.0.0.1, ::1]
        --days N = 365: days for which the certificates are valid, 1 to 36500 [default: %(default)s]
        """,
    ),
    CommandEntry(
        *("containers", "Deploy", "Write a compose file with a container for each robot."),
        *("tandem containers group-8 containers.yaml", "docs/howto-containers.md"),
        f"{SCENARIO}\n    file FILE: compose file to write; an existing file is not replaced",
    ),
    CommandEntry(
        *("audit", "Analyse", "Check a recording against the rules of the system."),
        *("tandem audit recording", "docs/howto-audit.md"),
        f"{RECORDING}{TRUSTED_PLANNER}",
    ),
    CommandEntry(
        *("figures", "Analyse", "Draw the figures of a recording."),
        *("tandem figures recording --only encounter --format svg", "docs/howto-figures.md"),
        f"""{RECORDING}{TRUSTED_PLANNER}
        --only NAME+: draw only this figure; may be repeated [default: all of {", ".join(PICTURES)}]
        --format+: write only this format; may be repeated [default: all of {", ".join(FIGURE_FORMATS)}]
        --paper: draw for a paper: 3.5 or 7.16 inches wide, 8 point text, no title
        --no-legend: draw no legends; write their content, with the title, to a text file beside each figure
        --out DIR: folder for the figures [default: the folder figures of the recording]
        """,
    ),
    CommandEntry(
        *("export", "Analyse", "Convert a recording to MCAP, CSV, Parquet or a factor graph."),
        *("tandem export recording --out exported", "docs/howto-export.md"),
        f"""{RECORDING}
        --out DIR: folder for the files [default: the recording's]
        --pyfg: write only run.pyfg: odometry, ranges and true poses as a factor graph for other estimators
        | --html: write only run.html: the page of the run in one file, which a browser opens without a server
        | --rerun: write only run.rrd: a recording for Rerun, with its views in place (extra rerun)
        | --tum: write only TUM files, for evo: true, estimated and dead-reckoned poses of each robot; also \
            from the folder of `tandem estimate --out`
        """,
    ),
    CommandEntry(
        *("estimate", "Analyse", "Estimate the poses of robots from recorded odometry and ranges."),
        "tandem estimate tests/data/uwb/tiers-a-b-30-s.pyfg --noise uwb-calibrated --out estimated",
        "docs/howto-estimate.md",
        f"""
        recording FILE: {RANGES}; with --follow, - is standard input
        --follow: read an MCAP stream from FILE, a pipe, and print the lines of estimate.csv as it arrives
        --robots A,B,...: robots whose poses are estimated; three or more in one fit \
            [default: all of the recording]
        --noise PROFILE: assumed noise: a profile, or a TOML file with [mission.noise], as `tandem \
            calibrate` writes [default: the sigmas that the recording states, else uwb]
        {PART_OF_RECORDING}
        --relative ROBOT: estimate in the frame of this robot's first pose, without the positions of anchors \
            [default: the frame of the recording]
        --accuracy M = 0.3: sigma of the position in m that a claim needs [default: %(default)g]
        --confidence P = 0.9999: probability that a claim needs [default: %(default)g]
        --solver MODULE:CLASS: solver of your own, which fits the poses [default: the smoother]
        --out DIR: folder for estimate.csv, estimate.json and figures [default: none are written]
        """,
    ),
    CommandEntry(
        *("calibrate", "Analyse", "Measure the errors of radios in a recording, as a noise profile."),
        *("tandem calibrate tests/data/uwb/tiers-a-b-30-s.pyfg --out radios.toml", "docs/howto-estimate.md"),
        f"""
        recording FILE: {RANGES}
        --robots A,B: the robots whose radios are calibrated [default: all]
        {PART_OF_RECORDING}
        --without-truth: use no true poses, but those of an estimate with the profile uwb
        --out FILE: TOML file for the profile, for `tandem estimate --noise` [default: it is printed]
        """,
    ),
    CommandEntry(
        *("watch", "Analyse", "Serve a web page that shows recordings or live missions."),
        *("tandem watch recording --port 8080\n  tandem watch paper assured", "docs/howto-watch.md"),
        f"""
        recording DIR*: folder of a recording, of several recordings, of a sweep or of an estimate; two \
            recordings are shown side by side with one clock [default: live missions]
        {MODEL}{TRUSTED_PLANNER}{CONNECTION}
        --address IP = 127.0.0.1: IP address on which the page is served; 0.0.0.0 in a container whose port \
            is published on loopback [default: %(default)s]
        {PAGE_PORT}
        --launched
        --lockstep
        """,
    ),
    CommandEntry(
        *("doctor", "Check", "Check this machine, its keys and its network before a mission."),
        *("tandem doctor --connect tls/10.0.0.1:7447 --keys keys/agent-a", "docs/network.md"),
        f"""{CONNECTION}
        --listen ENDPOINT+: endpoint on which a world, an agent or a router will listen, {ENDPOINT}
        {LISTENING_TIME}""",
    ),
    CommandEntry(
        *("ps", "Check", "List the missions on a network and the robots in them."),
        *("tandem ps --connect tcp/127.0.0.1:7447 --json", "docs/network.md"),
        f"{CONNECTION}{LISTENING_TIME}\n    --json: print JSON",
    ),
    CommandEntry(
        *("check-driver", "Check", "Check a driver against its contract; the robot moves."),
        *("tandem check-driver docs.rover:Rover --rate 10", "docs/driver.md"),
        f"""
        driver MODULE:CLASS: driver of the robot's wheels and sensors
        --mission FILE = paper-1: scenario that gives the robot's limits: a name or a TOML file \
            [default: %(default)s]
        --robot ID = a: robot of that scenario [default: %(default)s]
        {DRIVER_OPTIONS}""",
    ),
    CommandEntry(
        *("check-planner", "Check", "Check a planner of your own against its contract."),
        *("tandem check-planner mine:Greedy --mission noisy", "docs/own-planner.md"),
        f"""
        planner MODULE:CLASS: planner of your own, or an installed one
        --planner-option NAME=VALUE+: option of the planner; may be repeated
        --mission FILE = random: scenario in which it is tried: a name or a TOML file [default: %(default)s]
        {SEED}
        --fault FAULT+: fault of the radio, such as 'a->b: loss=0.3, delay=0..3'; may be repeated
        """,
    ),
    CommandEntry(
        *("completion", "Check", "Print a script with which bash or zsh completes `tandem`."),
        *("tandem completion bash", "docs/command-line.md"),
        "shell: the shell that runs the script",
    ),
)
"""All commands, in the order of `tandem --help`."""
