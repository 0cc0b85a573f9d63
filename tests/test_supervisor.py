"""Child processes are ended in bounded time, whatever they do, and are restarted when they are due."""

from __future__ import annotations

from collections.abc import Iterator
from signal import SIGKILL, SIGTERM

import pytest

from compose.launch import forked, supervisor
from compose.launch.supervisor import Supervisor
from protocol.network.inbox import Inbox
from tests.commands import BOUND_S

SLEEPS = "signal:pause"
"""The function of a child that does nothing until a signal ends it."""


@pytest.fixture
def children() -> Iterator[Supervisor]:
    """Yield a supervisor, whose children do not outlast the test."""
    supervised = Supervisor(Inbox("test"))
    yield supervised
    supervised.stop()


def test_children_end_by_one_sigterm_and_one_that_ignores_it_is_killed(
    children: Supervisor, monkeypatch: pytest.MonkeyPatch
) -> None:
    obedient = children.start("obedient", main=SLEEPS)
    monkeypatch.setattr(supervisor, "STOP_S", BOUND_S)
    children.stop()
    assert obedient.status == -SIGTERM
    stubborn = children.start("stubborn", main="tests.misbehaving:stubborn")
    assert stubborn.receive(BOUND_S) == b"ready"
    monkeypatch.setattr(supervisor, "STOP_S", 0.2)
    children.stop()
    assert stubborn.status == -SIGKILL


def test_a_child_that_does_not_read_what_it_is_sent_is_killed(
    children: Supervisor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(forked, "SEND_S", 0.2)
    deaf = children.start("deaf", main=SLEEPS)
    deaf.send(bytes(1 << 20))  # more than a socket holds
    assert deaf.wait(BOUND_S)
    assert deaf.status == -SIGKILL


def test_a_child_is_restarted_when_it_is_due_and_its_end_is_reported_by_name(children: Supervisor) -> None:
    children.start("a", main=SLEEPS).kill()
    assert children.next_end(BOUND_S) == "a"
    children.start_later(0.01, lambda: children.start("a", main="os:getpid"))
    assert children.next_end(BOUND_S) == "a"
    assert children["a"].status == 0
    assert children.next_end(0.0) is None


def test_a_start_that_is_cancelled_does_not_happen(children: Supervisor) -> None:
    children.start_later(0.0, lambda: children.start("a", main="os:getpid"))
    children.cancel_starts()
    assert children.next_end(0.1) is None
