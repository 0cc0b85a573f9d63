"""Planners by name: shipped ones, installed ones, and classes of the user (see `class_loader`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from compose.errors import UserError, no_such, user_code, within
from compose.launch.class_loader import GuardedSolver, entry_points, named
from protocol.messages import RobotConfig
from protocol.mission import Mission
from protocol.orbits import RENDEZVOUS, Rendezvous, rendezvous

if TYPE_CHECKING:
    from agent.planning.planner import Planner


GROUP = "tandem.planners"
"""The group of entry points with which packages add planners."""
PLANNER_NAMES = tuple(sorted(RENDEZVOUS))
"""The names of the shipped planners. Their orbits are known without loading them."""
PLANNER_METHODS = ("start", "observe", "decide", "command", "estimate")
"""The methods that a planner must define."""

GROUP_PLANNER = "assured"
"""The shipped planner with which robots can form a group. Those of users are subclasses of its classes."""


def is_shipped(name: str) -> bool:
    """Return whether `name` is a planner that is shipped with Tandem."""
    return name in PLANNER_NAMES


def installed() -> dict[str, Any]:
    """Return the entry points of installed packages that add planners, by name."""
    return {name: one for name, one in entry_points(GROUP).items() if name not in PLANNER_NAMES}


def check(name: str, options: Mapping[str, Any]) -> None:
    """Load the planner, and create it.

    Raises UserError, whose text begins with the field of the table `[planner]`, if that is not possible, or
    not permitted.
    """
    if not is_shipped(name):
        with within("name: ", UserError):
            planner_class(name)
        _created(name, options)
    elif options:
        raise UserError(f"options: the planner '{name}' has none")


def planner_of(config: RobotConfig) -> Planner[Any, Any]:
    """Return the planner of the robot with this configuration, in a guard unless it is shipped with Tandem.

    Raises UserError if it cannot be loaded or created, and Untrusted if the user has not named it.
    """
    found = unguarded_planner_of(config)
    return found if is_shipped(config.planner_name) else _guarded(config.planner_name, found)


def unguarded_planner_of(config: RobotConfig) -> Planner[Any, Any]:
    """Return a new planner of the robot with this configuration, without a guard. Raises UserError."""
    name = config.planner_name
    if config.team is not None and is_shipped(name):
        from agent.planning.team import TeamPlanner  # noqa: PLC0415  # it imports numpy

        return TeamPlanner()
    found = _created(name, config.planner_options)
    if not config.members:
        return found
    from agent.planning.assured import Assured  # noqa: PLC0415  # it imports numpy
    from agent.planning.group import GroupPlanner  # noqa: PLC0415  # likewise
    from agent.planning.meeting_planner import MeetingPlanner  # noqa: PLC0415  # likewise
    from agent.planning.unanchored import UnanchoredPlanner  # noqa: PLC0415  # likewise

    if config.given_anchor is None:
        return GroupPlanner(UnanchoredPlanner())
    if isinstance(found, Assured):
        return GroupPlanner(found)
    if not meets(type(found)):
        raise UserError(f"robots with the planner {name} meet in pairs, not in a group")
    return GroupPlanner(MeetingPlanner(found))


def is_for_groups(name: str, *, helps: bool = False) -> bool:
    """Return whether robots with the planner `name` can form a group. Raises like `planner_class`.

    If it `helps` robots without an anchor, or those that have met attackers, only `assured` can.
    """
    if is_shipped(name):
        return name == GROUP_PLANNER
    from agent.planning.assured import Assured  # noqa: PLC0415  # it imports numpy

    found = planner_class(name)
    return issubclass(found, Assured) or (not helps and meets(found))


def is_for_teams(name: str) -> bool:
    """Return whether robots with the planner `name` can form a team. Raises like `planner_class`.

    Planners that exchange the logs of pairs cannot. All others are given the team and may use it.
    """
    if is_shipped(name):
        return name == GROUP_PLANNER
    from agent.planning.exchange import LogPlanner  # noqa: PLC0415  # it imports numpy

    return not issubclass(planner_class(name), LogPlanner)


def meets(planner: type[Planner[Any, Any]]) -> bool:
    """Return whether `planner` can begin another meeting."""
    from agent.planning.planner import Planner  # noqa: PLC0415  # it imports numpy

    return planner.meet is not Planner.meet


def _guarded(name: str, found: Planner[Any, Any]) -> Planner[Any, Any]:
    from compose.launch.planner_guard import GuardedPlanner  # noqa: PLC0415  # it imports numpy

    return GuardedPlanner(name, found)


def orbits(name: str, options: Mapping[str, Any], mission: Mission, distance: float) -> Rendezvous:
    """Return the orbits of a planner for anchors `distance` m (D) apart. Raises like `planner`."""
    if is_shipped(name):
        return rendezvous(mission, distance, name)
    return _guarded(name, _created(name, options)).rendezvous(mission, distance)


def planner_class(name: str) -> type[Planner[Any, Any]]:
    """Return the class of a planner. Raises UserError if it is not one, and Untrusted."""
    from agent.planning.planner import Planner  # noqa: PLC0415  # it imports numpy

    if is_shipped(name):
        from agent.planning.assured import Assured  # noqa: PLC0415  # it imports numpy
        from agent.planning.paper import Paper  # noqa: PLC0415  # likewise

        return {"assured": Assured, "paper": Paper}[name]
    try:
        found = named(name, "planner", GROUP)
    except KeyError:
        names = [*PLANNER_NAMES, *installed()]
        raise UserError(no_such(name, names, "; a planner of your own is MODULE:CLASS")) from None
    if not isinstance(found, type) or not issubclass(found, Planner):
        raise UserError(f"{name}: is not a planner: not a subclass of tandem.planning.Planner")
    if hasattr(found, "suited"):
        raise UserError(f"{name}: suited() was removed in version 0.3: a planner asks config.mission.noise")
    missing = [method for method in PLANNER_METHODS if getattr(found, method) is getattr(Planner, method)]
    if missing:
        raise UserError(f"{name}: is not a planner: it does not define {', '.join(missing)}")
    return found


def _created(name: str, options: Mapping[str, Any]) -> Planner[Any, Any]:
    maker = planner_class(name)
    with user_code(f"options: {name} cannot be created:"):
        created = maker(**options)
    if (solver := getattr(created, "SOLVER", None)) is not None:
        GuardedSolver(solver, f"name: {name}: SOLVER: ")
    return created
