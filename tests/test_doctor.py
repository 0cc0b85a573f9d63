"""`tandem doctor`: each check passes in a correct setup and fails in a broken one, without side effects."""

from __future__ import annotations

import re
import shutil
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from datetime import timedelta
from functools import partial
from importlib import import_module
from pathlib import Path
from signal import Signals
from typing import Any

import pytest
import tomli_w
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    PrivateFormat,
    load_pem_private_key,
)

from agent.estimation import compiled
from compose import extras
from compose.doctor.certificate_checks import certificate_findings
from compose.doctor.network_checks import APART_S, compared
from compose.launch.processes import free_endpoint
from compose.network import KEYED
from protocol.network import keys as tree
from protocol.network import session
from protocol.network.diagnosis import MUTE
from protocol.network.endpoints import configured, listening
from protocol.wire import VERSION
from tests.commands import LONGER, Ended, TandemProcess, tandem, world
from tests.series import series
from tests.test_keys import expire, give_foreign, last, world_of
from tests.test_noisy_unanchored import NOISE
from tests.test_topologies import Router, connect, listen, record_of, routing, same
from tests.test_unanchored import four


def findings(ended: Ended, mark: str) -> list[str]:
    """Return the text of the lines with that mark; every line has a mark, and the exit status agrees."""
    assert ended.err == ""
    lines = ended.out.splitlines()
    assert all(re.match(r"(ok |fix|--) ", line) for line in lines), ended.out
    assert ended.status == any(line.startswith("fix") for line in lines)
    return [line[4:] for line in lines if line.startswith(mark)]


def only_fix(ended: Ended, *words: str) -> None:
    """Assert that there is exactly one finding to fix, and that it contains these words."""
    (found,) = findings(ended, "fix")
    for word in words:
        assert word in found


# --- this machine ---------------------------------------------------------------------------------------


def test_versions_are_printed(tmp_path: Path) -> None:
    ended = tandem("doctor")
    (said,) = findings(ended, "ok")
    for name in ("python 3.", "eclipse-zenoh 1.", "numpy ", "scipy ", "msgpack ", "msgspec "):
        assert name in said
    assert f"tandem-ranging {extras.version()}" in said
    assert said.endswith(f", estimator compiled by {compiled.compiler()}, protocol version {VERSION}")
    assert findings(ended, "--") == ["network: there is no --connect"]
    assert tandem("--version", cwd=tmp_path) == (
        0,
        f"tandem {extras.version()}, protocol version {VERSION}\n",
        "",
    )


def test_a_library_that_is_too_old_is_to_be_installed_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "numpy-1.26.4.dist-info").mkdir()
    (tmp_path / "numpy-1.26.4.dist-info" / "METADATA").write_text("Name: numpy\nVersion: 1.26.4\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with TandemProcess("doctor") as doctor:
        only_fix(doctor.ended(), "versions: numpy 1.26.4; tandem-ranging", "needs <3,>=2.2: install it again")


@pytest.fixture
def other_kernel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the file of the compiled estimator in a copy of `agent`, which new processes import."""
    shutil.copytree(compiled.LIBRARY_FILE.parents[1], tmp_path / "agent")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return tmp_path / "agent" / "estimation" / compiled.LIBRARY_FILE.name


def test_an_estimator_that_is_compiled_from_another_source_is_to_be_installed_anew(
    other_kernel: Path,
) -> None:
    with other_kernel.with_name(compiled.SOURCE_FILES[0].name).open("a") as file:
        file.write("/* changed */")
    with TandemProcess("doctor") as doctor:
        only_fix(
            doctor.ended(),
            f"versions: {other_kernel}: the estimator ",
            "one of smoother.c, elementary.c, hypotheses.c is another; install Tandem",
        )


def test_a_library_that_is_not_the_estimator_is_to_be_installed_anew(other_kernel: Path) -> None:
    shutil.copy(str(import_module("msgspec._core").__file__), other_kernel)
    with TandemProcess("doctor") as doctor:
        only_fix(
            doctor.ended(), f"versions: {other_kernel}: the estimator ", "symbol: source; install Tandem"
        )


def test_without_the_compiled_estimator_a_mission_that_needs_it_does_not_begin(other_kernel: Path) -> None:
    other_kernel.unlink()
    table = four()
    table["mission"] |= {"noise": NOISE, "accuracy": 0.3}
    scenario = other_kernel.with_name("four.toml")
    scenario.write_text(tomli_w.dumps(table), encoding="utf-8")
    with TandemProcess("run", scenario, "--in-process") as run, TandemProcess("run", "paper-1") as exact:
        status, out, err = run.ended()
        assert exact.ended().status == 0
    assert (status, out) == (3, "")
    begin = f"tandem run: cannot continue: {other_kernel}: the estimator is not compiled: "
    assert re.fullmatch(f"{re.escape(begin)}.*; install Tandem again .*\n", err)


def test_a_free_port_is_reported_and_a_port_in_use_is_a_problem() -> None:
    free, taken = free_endpoint(), free_endpoint()
    with session.open_router(listening(taken)):
        ended = tandem("doctor", *listen(free, taken))
    assert f"port: {free} is free" in findings(ended, "ok")
    only_fix(ended, f"port: {taken}: in use; end the process that uses it")


@pytest.mark.parametrize(
    ("endpoint", "words"),
    [
        ("tcp/192.0.2.1:7447", "not an address of this host; `ip address` lists them"),
        ("tcp/nowhere.invalid:7447", "there is no host 'nowhere.invalid'"),
    ],
)
def test_a_place_that_is_not_of_this_machine_is_none_to_listen_at(endpoint: str, words: str) -> None:
    first, exposed = findings(tandem("doctor", "--listen", endpoint), "fix")
    assert first.startswith(f"port: {endpoint}: {words}")
    assert exposed.startswith("port: listening without --keys at ")


def test_a_port_with_the_remains_of_an_old_link_is_free() -> None:
    endpoint = free_endpoint()
    port = int(endpoint.rpartition(":")[2])
    with socket.socket() as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        server.bind(("127.0.0.1", port))
        server.listen()
        with socket.create_connection(("127.0.0.1", port)) as client:
            accepted, _ = server.accept()
            accepted.close()  # the side that closes first keeps the port for a minute
            client.recv(1)
    assert findings(tandem("doctor", "--listen", endpoint), "fix") == []


# --- keys -----------------------------------------------------------------------------------------------


def test_keys_that_were_made_just_now_are_well(keys: Path) -> None:
    for name in ("agent-a", "world", "router", "viewer"):
        ended = tandem("doctor", "--keys", keys / name)
        assert findings(ended, "fix") == []
        said = findings(ended, "ok")
        own = keys / name
        assert f"key: only its owner can read {own / 'key.pem'}" in said
        assert f"certificate: {own / 'cert.pem'} is signed by ca.pem and is of {name}" in said
        assert f"names: certificate and configuration are of {name}" in said
        assert any(one.startswith(f"certificate: {own / 'cert.pem'} is valid until") for one in said)


def let_read(own: Path, _keys: Path) -> None:
    (own / "key.pem").chmod(0o640)


def soon(own: Path, keys: Path) -> None:
    last(own, keys, timedelta(days=20, hours=1))


def mix_keys(own: Path, keys: Path) -> None:
    shutil.copy(keys / "agent-b" / "key.pem", own / "key.pem")


def mix_names(own: Path, keys: Path) -> None:
    for name in ("cert.pem", "key.pem"):
        shutil.copy(keys / "agent-b" / name, own / name)


def lock(own: Path, _keys: Path) -> None:
    key = load_pem_private_key((own / "key.pem").read_bytes(), None)
    locked = BestAvailableEncryption(b"secret")
    (own / "key.pem").write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, locked))


def spoil(own: Path, _keys: Path) -> None:
    (own / "cert.pem").write_text("nonsense")


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (expire, ("cert.pem expired on 20", "create it again with `tandem keys`")),
        (soon, ("cert.pem expires on 20", "in 20 days")),
        (give_foreign, ("cert.pem is not accepted by", "ca.pem: unable to get local issuer certificate")),
        (let_read, ("other users can read", "chmod 600")),
        (mix_keys, ("key.pem is not its key",)),
        (mix_names, ("cert.pem is of agent-b, and", f"{KEYED} of agent-a; copy the folder of agent-a")),
        (lock, ("certificate: ", "cert.pem: with key.pem and ca.pem it cannot be read")),
        (spoil, ("certificate: ", "cert.pem: with key.pem and ca.pem it cannot be read")),
    ],
)
def test_an_invalid_key_is_a_problem(
    damage: Callable[[Path, Path], None], words: tuple[str, ...], keys: Path, mine: Path
) -> None:
    assert findings(tandem("doctor", "--keys", mine), "fix") == []
    damage(mine, keys)
    only_fix(tandem("doctor", "--keys", mine), *words)


def test_the_folder_of_another_robot_is_a_problem(keys: Path, tmp_path: Path) -> None:
    wrong = shutil.copytree(keys / "agent-b", tmp_path / "agent-a")
    words = f"names: the folder {wrong} contains the keys of agent-b; copy the folder of agent-a"
    only_fix(tandem("doctor", "--keys", wrong), words)


def test_a_certificate_without_the_listen_address_is_a_problem(keys: Path) -> None:
    where = free_endpoint("tls")
    assert findings(tandem("doctor", "--keys", keys / "world", "--listen", where), "fix") == []
    where = where.replace("127.0.0.1", "127.0.0.2")
    words = ("cert.pem does not name 127.0.0.2", "`tandem keys --host 127.0.0.2`")
    only_fix(tandem("doctor", "--keys", keys / "world", "--listen", where), *words)


def test_a_certificate_is_not_valid_before_its_time(mine: Path) -> None:
    found = list(certificate_findings(configured(mine / KEYED), now=0.0))
    # one of the robot and one of the CA
    assert [one.mark for one in found if "is not valid before" in one.text] == ["fix", "fix"]


# --- the network ----------------------------------------------------------------------------------------


@pytest.mark.long
def test_an_endpoint_without_a_listener_is_reported_with_a_remedy() -> None:
    nowhere = free_endpoint()
    with world("paper-1", "--run", "mine") as (_, endpoint):
        ended = tandem("doctor", *connect(nowhere, endpoint))
    only_fix(ended, f"router: no router at {nowhere}: nothing listens there; check the address")
    said = findings(ended, "ok")
    assert f"router: {endpoint} answers, in the clear" in said
    agrees = re.compile(r"clock: the router's agrees with this host's within 0\.\d+ s")
    assert any(map(agrees.fullmatch, said))
    assert said[-1] == "alive: mine: its world, all with this protocol version; not alive: a, b"


@pytest.mark.long
def test_a_refusal_by_the_router_is_explained(keys: Path, mine: Path) -> None:
    expire(mine, keys)
    with world_of(keys) as endpoint:
        own, link = findings(tandem("doctor", "--keys", mine, "--connect", endpoint), "fix")
    assert "cert.pem expired" in own
    assert link == f"router: no router at {endpoint}: this certificate has expired; check the certificate"


@pytest.mark.parametrize("command", series(["doctor", "ps"]))
@pytest.mark.long
def test_the_wait_for_a_listener_that_sends_nothing_is_bounded_and_can_be_interrupted(
    command: str,
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as mute:
        endpoint = f"tcp/127.0.0.1:{mute.getsockname()[1]}"
        with TandemProcess(command, *connect(endpoint)) as stopped:
            mute.accept()[0].close()  # the command has connected
            stopped.tell(Signals.SIGINT)
            assert stopped.ended().status == 130
        ended = tandem(command, *connect(endpoint))
    assert ended.status == (1 if command == "doctor" else 3)
    assert f"no router at {endpoint}: {MUTE}" in ended.out + ended.err


def test_a_network_without_missions_is_reported() -> None:
    endpoint = free_endpoint()
    with session.open_router(listening(endpoint)):
        ended = tandem("doctor", *connect(endpoint))
    assert findings(ended, "ok")[-1] == "alive: no mission is running on this network"
    assert findings(ended, "--") == []


@contextmanager
def of_another_version(keys: Path) -> Iterator[str]:
    """Yield the endpoint of a world that answers with a later version of the protocol."""
    endpoint = free_endpoint("tls")
    with session.open_router(configured(keys / "world" / KEYED, listen=[endpoint])) as link:

        def brief(query: Any) -> None:
            query.reply(query.key_expr, bytes([VERSION + 1]) + b"whatever it says")

        link.declare_queryable(tree.config("r", "*"), brief)
        tokens = [
            session.show_alive(link, key) for key in (tree.world_alive("r"), tree.robot_alive("r", "b"))
        ]
        yield endpoint
        del tokens


@pytest.mark.parametrize("who", ["agent-a", "viewer"])
def test_a_world_of_another_protocol_version_is_reported(who: str, keys: Path) -> None:
    with of_another_version(keys) as endpoint:
        flags = ("--connect", endpoint, "--keys", keys / who, "--timeout", "0.2")
        only_fix(
            tandem("doctor", *flags),
            f"versions: r has protocol version {VERSION + 1}, and this machine {VERSION}; install",
        )


def test_a_robot_that_the_world_does_not_know_is_reported(keys: Path, tmp_path: Path) -> None:
    everybody = shutil.copytree(keys, tmp_path / "keys")
    assert tandem("keys", everybody, "--robots", "c").status == 0
    endpoint = free_endpoint("tls")
    arguments = ("world", "paper-1", "--run", "mine", "--listen", endpoint, "--keys", everybody / "world")
    with TandemProcess(*arguments) as part:
        part.until_prints("waiting for")
        ended = tandem("doctor", "--connect", endpoint, "--keys", everybody / "agent-c")
    only_fix(ended, "alive: mine: this world has no robot 'c'; it has a, b")


@pytest.mark.parametrize(
    ("ahead", "took", "mark", "words"),
    [
        (0.001, 0.002, "ok", "this host's within 0.002 s"),
        (5.0, 0.5, "ok", "between 4.500 and 5.000 s ahead"),
        (-3.0, 0.5, "ok", "between 3.000 and 3.500 s behind"),
        (APART_S + 2.0, 1.0, "fix", "ahead; set one of the two (`timedatectl`)"),
        (-APART_S - 0.1, 1.0, "fix", "behind; set one of the two (`timedatectl`)"),
        (APART_S + 0.5, 1.0, "ok", "decisions do not depend on it"),
    ],
)
def test_clock_offsets_are_measured_within_their_uncertainty(
    ahead: float, took: float, mark: str, words: str
) -> None:
    found = compared(ahead, took)
    assert found.mark == mark
    assert words in found.text


# --- a router with keys ---------------------------------------------------------------------------------


@contextmanager
def router_by(keys: Path, folder: Path) -> Iterator[str]:
    """Yield the endpoint of a router with these keys."""
    endpoint = free_endpoint("tls")
    with routing(Router(endpoint, (), keys / "router"), folder):
        yield endpoint


def start(
    keys: Path, endpoint: str, out: Path, stack: ExitStack, who: str, *arguments: str | Path
) -> TandemProcess:
    """Start a process of a mission with the keys of `who`."""
    where = ("--connect", endpoint, "--keys", keys / who, "--out", out, "-q")
    return stack.enter_context(TandemProcess(*arguments, *where))


# --- no mission is disturbed ----------------------------------------------------------------------------


@pytest.mark.long("slow")
def test_the_doctor_does_not_change_the_recording_of_a_mission(keys: Path, tmp_path: Path) -> None:
    """It runs before b joins, while all robots move, and several times at once."""
    expected, out = record_of(LONGER, tmp_path), tmp_path / "out"
    with router_by(keys, tmp_path) as endpoint, ExitStack() as stack:
        part = partial(start, keys, endpoint, out, stack)
        started = {
            "world": part("world", "world", tmp_path / "scenario.toml", "--run", "mine"),
            "a": part("agent-a", "agent", "a"),
        }
        started["a"].until_answered("a", out)
        doctors = [
            stack.enter_context(
                TandemProcess("doctor", "--connect", endpoint, "--keys", keys / who, "--timeout", "20")
            )
            for who in ("agent-a", "agent-b", "viewer")
        ]
        for doctor in doctors[:2]:
            doctor.until_prints("clock:")
        started["b"] = part("agent-b", "agent", "b")
        listing = tandem("ps", "--connect", endpoint, "--keys", keys / "viewer")
        assert listing.status == 0
        same(started, out, expected)
        for doctor in doctors:
            ended = doctor.ended()
            assert ended.status == 0
            assert ended.err == ""
