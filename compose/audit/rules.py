"""The audit of a recording by all rules."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from compose.audit import scenario_rules
from compose.audit.agent_rules import decision, limits, log
from compose.audit.claim_rules import bound, claim, distance, outcome
from compose.audit.delivery_rules import contact, link_statistics, observation, report
from compose.audit.findings import Checks, Findings, findings_of
from compose.audit.journal_rules import config, order
from compose.audit.scenario_rules import scenario
from compose.recording.recording_files import agent_journal
from compose.recording.run import Run
from protocol.journal.environment import of_robot, of_world, otherwise

Rules = Sequence[Callable[[Run], Checks]]
AUDIT_RULES: Rules = (
    order,
    scenario,
    config,
    observation,
    contact,
    report,
    decision,
    limits,
    log,
    claim,
    distance,
    bound,
)
"""The rules of the audit, in order: if violations of one cause violations of another, it comes first."""
HARDWARE_RULES: Rules = (order, scenario_rules.config, report, decision, limits, log)
"""The rules of the audit in hardware mode, where there is no ground truth: the decisions of each robot follow
from its inputs, and it received what its peer sent."""

REPLAY_RULES: Rules = (config, observation, contact, report, decision, order, outcome)
"""The rules that recompute something, in the order of a tick: the first difference causes later ones."""
HARDWARE_REPLAY_RULES: Rules = (report, decision, order)
"""The rules of a replay that need no ground truth."""


def replayed(run: Run) -> Findings:
    """Run `run` again from the journaled inputs, and return where it differs, to the bit.

    The world moves by the journaled Commands and computes new Observations. Each robot's planner runs on the
    Observations and Reports that its process received. In hardware mode, only the agents' journals are
    replayed. Raises CorruptJournal if a frame cannot be decoded or is in the journal of another robot.
    """
    return audit_run(run, REPLAY_RULES, HARDWARE_REPLAY_RULES)


def audit_run(run: Run, rules: Rules = AUDIT_RULES, hardware_rules: Rules = HARDWARE_RULES) -> Findings:
    """Return the findings in `run`: of `rules`, or of `hardware_rules` if there is no world's journal.

    Raises OSError and CorruptJournal if a robot's journal cannot be read.
    """
    run.readable(*map(agent_journal, run.robots))
    if run.world is None:
        return findings_of(
            hardware_rules,
            run,
            _other_versions(run),
            scenario=f"{' and '.join(run.robots)}, hardware mode",
            ticks=max(0, run.length - 1),
        )
    return findings_of(
        rules,
        run,
        otherwise(run.world.environment, of_world()) or _other_versions(run),
        scenario=run.scenario.name,
        ticks=max(0, run.length - 1),
        links=link_statistics(run),
    )


def _other_versions(run: Run) -> str | None:
    """Return how the versions of the first robot that has others differ from those of this process.

    The result is None if no robot has other versions.
    """
    differences = [otherwise(agent.environment, of_robot()) for agent in run.agents.values()]
    return next((one for one in differences if one is not None), None)
