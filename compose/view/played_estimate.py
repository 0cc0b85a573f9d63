"""An estimate from a range recording as the page plays it: a run of robots that share all measurements.

A tick is an epoch of the estimate. Its messages are those that such robots would send; their commands say
which poses may be claimed, and no more: nobody knows what the robots were told.
"""

from __future__ import annotations

from pathlib import Path

import msgspec

from compose.errors import UserError
from compose.recording.run_setup import ESTIMATED, RunSetup
from compose.view.run_data import RunData
from protocol import documents, files
from protocol.messages import Command, Estimate, MissionEnd, Observation
from protocol.motion import Pose
from protocol.units import Tick

PLAYER_JSON = "player.json"
"""The file in the folder of an estimate."""


class Epoch(msgspec.Struct, frozen=True):
    """One epoch: the true poses that are known, and the messages of all robots."""

    tick: Tick
    truth: dict[str, Pose]
    messages: list[Observation | Command | Estimate]


class PlayedEstimate(msgspec.Struct, frozen=True):
    """The content of the file."""

    setup: RunSetup
    epochs: list[Epoch]
    end: MissionEnd

    def __post_init__(self) -> None:
        """Raise ValueError for what no estimate has."""
        ids, known = self.setup.ids, {*self.setup.ids}
        ticks = [one.tick for one in self.epochs]
        told = {(one.tick, each.tick, each.robot) for one in self.epochs for each in one.messages}
        told |= {(one.tick, one.tick, robot) for one in self.epochs for robot in one.truth}
        if not self.setup.team or self.setup.visits or self.setup.mode != ESTIMATED:
            raise ValueError("setup: it is not of an estimate")
        if not ids or len(known) < len(ids):
            raise ValueError("setup.robots: there are none, or two of one name")
        if not ticks or ticks != sorted({*ticks}) or ticks[-1] != self.end.tick:
            raise ValueError("epochs: their ticks do not increase to that of the end")
        if any(tick != own or robot not in known for tick, own, robot in told):
            raise ValueError("epochs: something is of another robot or tick")

    def run_data(self) -> RunData:
        """Return the data of all epochs."""
        known = RunData()
        for one in self.epochs:
            known.at(one.tick).truth.update(one.truth)
            known.has_truth = known.has_truth or bool(one.truth)
            for message in one.messages:
                known.add(message)
        known.conclude(self.end)
        return known


def read_player(folder: Path) -> PlayedEstimate | None:
    """Return the content of the file in `folder`; None without one. Raises UserError if it cannot be read."""
    try:
        content = files.read_inside(folder, PLAYER_JSON, most=documents.MOST_DOCUMENT_BYTES)
        found: PlayedEstimate = documents.json_value(content, PlayedEstimate)
    except FileNotFoundError:
        return None
    except (OSError, msgspec.MsgspecError, ValueError) as error:
        raise UserError(f"{folder / PLAYER_JSON} cannot be read: {documents.flaw(error)}") from None
    return found
