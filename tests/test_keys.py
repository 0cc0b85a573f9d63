"""Certificates: the files of `tandem keys`, and the refusal of participants without a valid one."""

from __future__ import annotations

import json
import re
import shutil
import ssl
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, load_pem_private_key

from compose.launch.processes import free_endpoint
from compose.network import KEYED
from compose.security import certificates
from protocol.network import keys as tree
from protocol.network import session
from protocol.network.diagnosis import MUTE
from protocol.network.endpoints import BadConfiguration, configured, listening
from tests.commands import TandemProcess, decided, refused, tandem

EVERYBODY = ("agent-a", "agent-b", "router", "viewer", "world")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# --- the files ------------------------------------------------------------------------------------------


def test_everybody_has_a_folder_with_all_that_one_machine_needs(keys: Path) -> None:
    assert sorted(path.name for path in keys.iterdir() if path.is_dir()) == list(EVERYBODY)
    for name in EVERYBODY:
        own = keys / name
        assert sorted(path.name for path in own.iterdir()) == ["ca.pem", "cert.pem", "key.pem", KEYED]
        assert own.joinpath("ca.pem").read_bytes() == keys.joinpath("ca.pem").read_bytes()
        context = ssl.create_default_context(cafile=own / "ca.pem")
        context.load_cert_chain(own / "cert.pem", own / "key.pem")  # raises if they do not match
        certificate = x509.load_pem_x509_certificate((own / "cert.pem").read_bytes())
        certificate.verify_directly_issued_by(x509.load_pem_x509_certificate((own / "ca.pem").read_bytes()))
        assert certificate.subject.rfc4514_string() == f"CN={name}"


def test_a_folder_of_keys_keeps_itself_out_of_repositories(keys: Path) -> None:
    subprocess.run(["git", "init", "-q", keys.parent], check=True)
    told = ["git", "status", "--porcelain", "--untracked-files=all", keys.name]
    listed = subprocess.run(told, cwd=keys.parent, capture_output=True, text=True, check=True)
    shutil.rmtree(keys.parent / ".git")
    assert listed.stdout == ""


def test_only_its_owner_reads_a_private_key(keys: Path) -> None:
    private = [path for path in keys.rglob("*") if path.is_file() and b"PRIVATE" in path.read_bytes()]
    assert {path.name for path in private} == {"key.pem", "ca-key.pem"}
    assert len(private) == len(EVERYBODY) + 1
    assert {path.stat().st_mode & 0o777 for path in private} == {0o600}


def test_existing_keys_stay_and_new_robots_are_added_to_the_rules(tmp_path: Path) -> None:
    folder = tmp_path / "keys"
    assert tandem("keys", folder, "--robots", "a,b", "--days", "3").status == 0
    before = contents(folder)
    ended = tandem("keys", folder, "--robots", "c")
    assert ended.status == 0
    assert "created, valid for 365 days: agent-c\n" in ended.out
    assert "unchanged: router, world, viewer, agent-a, agent-b\n" in ended.out
    after = contents(folder)
    changed = {name for name in before if after[name] != before[name]}
    assert changed == {f"{name}/{KEYED}" for name in EVERYBODY}
    named = {
        subject["id"] for subject in configured(folder / "router" / KEYED).setting("access_control/subjects")
    }
    assert named == {*EVERYBODY, "agent-c"}


def test_a_folder_that_is_removed_is_made_anew_by_the_same_authority(tmp_path: Path) -> None:
    folder = tmp_path / "keys"
    assert tandem("keys", folder, "--robots", "a", "--host", "robot.example").status == 0
    before = contents(folder)
    shutil.rmtree(folder / "world")
    assert tandem("keys", folder, "--robots", "a", "--host", "10.1.2.3").status == 0
    after = contents(folder)
    assert {name for name in before if before[name] != after[name]} == {"world/cert.pem", "world/key.pem"}
    names = {"world": "<IPAddress(value=10.1.2.3)>", "router": "<DNSName(value='robot.example')>"}
    for name, host in names.items():
        certificate = x509.load_pem_x509_certificate(after[f"{name}/cert.pem"])
        known = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        assert host in [str(one) for one in known]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--robots", "a,"), "'' is not a name"),
        (("--robots", "a,b,a"), "names a robot twice"),
        (("--robots", "../a"), "is not a name"),
        (("--robots", "a" * 33), "more than 32 characters"),
        (
            ("--robots", "a", "--host", "not a host"),
            "--host: 'not a host' is neither a host name nor an IP address",
        ),
        (("--robots", "a", "--days", "0"), "'0' is not a whole number from 1 to 36500"),
        ((), "--robots"),
    ],
)
def test_invalid_input_of_the_keys_command_is_one_line(
    arguments: tuple[str, ...], words: str, tmp_path: Path
) -> None:
    refused(tandem("keys", tmp_path / "keys", *arguments), words)
    assert not (tmp_path / "keys").exists()


def spoil_authority(folder: Path) -> None:
    (folder / "ca-key.pem").write_text("nonsense")


def lose_authority(folder: Path) -> None:
    (folder / "ca-key.pem").unlink()


def lose_key(folder: Path) -> None:
    (folder / "agent-a" / "key.pem").unlink()


def mix(folder: Path) -> None:
    for name in ("ca.pem", "ca-key.pem"):
        (folder / name).unlink()
    shutil.move(folder / "agent-a", folder.parent / "agent-a")
    shutil.rmtree(folder)
    assert tandem("keys", folder, "--robots", "b").status == 0
    shutil.move(folder.parent / "agent-a", folder / "agent-a")


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (spoil_authority, "its authority cannot be read"),
        (lose_authority, "is not empty and has no ca.pem with ca-key.pem"),
        (lose_key, "has no key.pem; remove the folder, and it is created again"),
        (mix, "is of another authority"),
    ],
)
def test_a_folder_that_is_damaged_is_left_as_it_is(
    damage: Callable[[Path], None], words: str, keys: Path, tmp_path: Path
) -> None:
    shutil.copytree(keys, tmp_path / "keys")
    damage(tmp_path / "keys")
    before = contents(tmp_path / "keys")
    refused(tandem("keys", tmp_path / "keys", "--robots", "a"), words)
    after = contents(tmp_path / "keys")
    assert {name: after[name] for name in before if not name.endswith(KEYED)} == {
        name: before[name] for name in before if not name.endswith(KEYED)
    }


# --- a mission over TLS ---------------------------------------------------------------------------------


def test_a_mission_with_tls_has_the_recording_of_one_without(tmp_path: Path) -> None:
    assert tandem("run", "paper-1", "-q", "--out", tmp_path / "open").status == 0
    ended = tandem("run", "paper-1", "-q", "--secure", "--out", tmp_path / "secured")
    assert ended == (0, "localised after 48 ticks\n", "")
    assert decided(tmp_path / "secured") == decided(tmp_path / "open")


def test_a_folder_of_keys_may_lie_anywhere(keys: Path, mine: Path, tmp_path: Path) -> None:
    endpoint = free_endpoint("tls")
    with (
        TandemProcess("world", "paper-1", "--listen", endpoint, "--keys", keys / "world") as world,
        TandemProcess("agent", "a", "--connect", endpoint, "--keys", mine.name, cwd=tmp_path) as a,
        TandemProcess("agent", "b", "--connect", endpoint, "--keys", keys / "agent-b") as b,
    ):
        for part in (a, b, world):
            assert part.ended().status == 0


# --- refused participants -------------------------------------------------------------------------------


@contextmanager
def world_of(keys: Path, name: str = "world") -> Iterator[str]:
    """Yield the endpoint of a process that declares the liveliness token of a world."""
    endpoint = free_endpoint("tls")
    with session.open_router(configured(keys / name / KEYED, listen=[endpoint])) as link:
        _token = session.show_alive(link, tree.world_alive("mine"))
        yield endpoint


def authority_of(keys: Path) -> certificates.Authority:
    key = load_pem_private_key((keys / "ca-key.pem").read_bytes(), None)
    assert isinstance(key, ec.EllipticCurvePrivateKey)
    return certificates.Authority(x509.load_pem_x509_certificate((keys / "ca.pem").read_bytes()), key)


def last(own: Path, keys: Path, lasts: timedelta) -> None:
    """Replace the certificate by one that expires after this time."""
    key = load_pem_private_key((own / "key.pem").read_bytes(), None)
    assert isinstance(key, ec.EllipticCurvePrivateKey)
    name = "world" if own.name == "world" else "agent-a"
    issued = certificates.issue(
        authority_of(keys), name, key.public_key(), certificates.CERTIFIED_HOSTS, lasts
    )
    (own / "cert.pem").write_bytes(issued.public_bytes(Encoding.PEM))


def expire(own: Path, keys: Path) -> None:
    """Replace the certificate by one that expired an hour ago."""
    last(own, keys, timedelta(hours=-1))


def give_foreign(own: Path, _keys: Path) -> None:
    """Replace the certificate by one of another authority. The trusted authority stays the right one."""
    other = own.parent / "others"
    assert tandem("keys", other, "--robots", "a").status == 0
    for name in ("cert.pem", "key.pem"):
        shutil.copy(other / "agent-a" / name, own / name)


def take_away(own: Path, _keys: Path) -> None:
    """Remove the certificate."""
    settings = json.loads((own / KEYED).read_text().partition("\n")[2])
    tls = settings["transport"]["link"]["tls"]
    for name in [name for name in tls if name.startswith(("connect_", "listen_"))]:
        del tls[name]
    (own / KEYED).write_text(json.dumps(settings))


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (expire, "this certificate has expired; check the certificate"),
        pytest.param(
            give_foreign,
            "it does not trust the authority of this certificate; check the certificate",
            marks=pytest.mark.long,
        ),
        pytest.param(
            take_away,
            "it requires a certificate, and there is none; check the certificate",
            marks=pytest.mark.long,
        ),
    ],
)
def test_an_invalid_certificate_is_refused_with_the_reason(
    spoil: Callable[[Path, Path], None], words: str, keys: Path, mine: Path
) -> None:
    spoil(mine, keys)
    with world_of(keys) as endpoint:
        ended = tandem("agent", "a", "--connect", endpoint, "--keys", mine, "--connect-timeout", "2")
    assert ended == (3, "", f"tandem agent a: no world at {endpoint}; gave up after 2 s: {words}\n")


@pytest.mark.long
def test_a_world_of_another_authority_is_refused(mine: Path, tmp_path: Path) -> None:
    other = tmp_path / "others"
    assert tandem("keys", other, "--robots", "a,b").status == 0
    with world_of(other) as endpoint:
        ended = tandem("agent", "a", "--connect", endpoint, "--keys", mine, "--connect-timeout", "2")
    assert ended.status == 3
    assert "its certificate is not valid here: unable to get local issuer certificate" in ended.err


@pytest.mark.long
def test_a_world_with_an_expired_certificate_is_refused(keys: Path, mine: Path, tmp_path: Path) -> None:
    shutil.copytree(keys / "world", tmp_path / "old" / "world")
    expire(tmp_path / "old" / "world", keys)
    with world_of(tmp_path / "old") as endpoint:
        ended = tandem("agent", "a", "--connect", endpoint, "--keys", mine, "--connect-timeout", "2")
    assert ended.status == 3
    assert "its certificate is not valid here: certificate has expired" in ended.err


@pytest.mark.long
def test_a_world_whose_name_is_not_in_its_certificate_is_refused(keys: Path, mine: Path) -> None:
    with world_of(keys) as endpoint:
        elsewhere = endpoint.replace("127.0.0.1", "127.0.0.2")
        with session.open_router(configured(keys / "world" / KEYED, listen=[elsewhere])):
            ended = tandem("agent", "a", "--connect", elsewhere, "--keys", mine, "--connect-timeout", "2")
    assert ended.status == 3
    assert "its certificate is not valid here: IP address mismatch" in ended.err


def test_a_robot_without_access_rules_is_advised_to_check_them(keys: Path, tmp_path: Path) -> None:
    shutil.copytree(keys, tmp_path / "keys")
    assert tandem("keys", tmp_path / "keys", "--robots", "c").status == 0
    with world_of(keys) as endpoint:
        own = tmp_path / "keys" / "agent-c"
        ended = tandem("agent", "c", "--connect", endpoint, "--keys", own, "--connect-timeout", "2")
    assert ended.status == 3
    assert (
        "a router answers; check that the world runs, and that its access rules name this robot" in ended.err
    )


@pytest.mark.long
def test_a_process_without_tls_is_advised_to_use_it(keys: Path) -> None:
    with world_of(keys) as endpoint:
        plain = endpoint.replace("tls/", "tcp/")
        ended = tandem("agent", "a", "--connect", plain, "--connect-timeout", "2")
    assert ended.status == 3
    assert "check that it is a Zenoh router, user and password, and tls/" in ended.err


@pytest.mark.long
def test_tls_at_a_plain_endpoint_is_advised_to_be_checked(mine: Path) -> None:
    endpoint = free_endpoint()
    with session.open_router(listening(endpoint)):
        secured = endpoint.replace("tcp/", "tls/")
        ended = tandem("agent", "a", "--connect", secured, "--keys", mine, "--connect-timeout", "2")
    assert ended.status == 3
    assert "check that it listens at tls/" in ended.err


@pytest.mark.long
def test_a_wrong_password_is_reported(tmp_path: Path) -> None:
    (tmp_path / "users").write_text("a:secret\n")
    accounts = {"auth": {"usrpwd": {"user": "r", "password": "r", "dictionary_file": "users"}}}
    (tmp_path / "router.json5").write_text(json.dumps({"transport": accounts}))
    for name, password in (("right", "secret"), ("wrong", "guess")):
        account = {"auth": {"usrpwd": {"user": "a", "password": password}}}
        (tmp_path / name).write_text(json.dumps({"transport": account}))
    endpoint = free_endpoint()
    with session.open_router(configured(tmp_path / "router.json5", listen=[endpoint])):
        part = ("agent", "a", "--connect", endpoint, "--connect-timeout", "2", "--config")
        right, wrong = (tandem(*part, tmp_path / name) for name in ("right", "wrong"))
    assert (right.status, wrong.status) == (3, 3)
    assert "a router answers; check that the world runs" in right.err
    assert wrong.err == f"tandem agent a: no world at {endpoint}; gave up after 2 s: {MUTE}\n"


@pytest.mark.long
def test_a_page_whose_certificate_is_refused_reports_it(keys: Path, tmp_path: Path) -> None:
    own = shutil.copytree(keys / "viewer", tmp_path / "viewer")
    take_away(own, keys)
    with world_of(keys) as endpoint, TandemProcess("watch", "--connect", endpoint, "--keys", own) as page:
        page.until_prints(f"no router at {endpoint} yet: it requires a certificate, and there is none")


# --- invalid configurations -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "expected array, boolean"),
        ("{mode: 'client', ", "line 1: expected identifier or string"),
        ("{\n nonsense: 1}", "unknown field `nonsense`, expected one of"),
        ("{transport: {unicast: {lowlatency: 'yes'}}}", "expected a boolean"),
        ("{mode: 'peer'}", "mode: 'peer', but a process that only connects is a client here; leave it out"),
        ("{connect: {endpoints: ['somewhere']}}", "Endpoints must be of the form"),
        (
            "{transport: {link: {tls: {root_ca_certificate: 'nowhere.pem'}}}}",
            "transport/link/tls/root_ca_certificate: ",
        ),
        (b"\xff\xfe", "is not UTF-8"),
        (None, "cannot be read: No such file or directory"),
    ],
)
def test_a_wrong_configuration_is_a_line_that_names_it(
    text: str | bytes | None, words: str, tmp_path: Path
) -> None:
    file = tmp_path / "mine.json5"
    if text is not None:
        file.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(BadConfiguration) as bad:
        configured(file, connect=["tcp/127.0.0.1:7447"])
    assert re.fullmatch(rf"{re.escape(str(file))}: .*{re.escape(words)}.*", str(bad.value))


@pytest.mark.parametrize("part", [("world", "paper-1"), ("agent", "a"), ("watch",)])
def test_a_command_refuses_a_wrong_configuration(part: tuple[str, ...], tmp_path: Path) -> None:
    file = tmp_path / "mine.json5"
    file.write_text("{mode: 'peer'}")
    ended = tandem(*part, "--connect", free_endpoint(), "--config", file)
    refused(ended, f"--config: {file}: mode: 'peer', but a process that only connects is a client here")


def test_a_configuration_may_name_the_endpoint(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    (tmp_path / "world.json5").write_text(
        f"{{mode: 'router', listen: {{endpoints: ['{endpoint}']}}}} // mine"
    )
    (tmp_path / "agent.json5").write_text(f"{{connect: {{endpoints: {{client: ['{endpoint}']}}}}}}")
    with (
        TandemProcess("world", "paper-1", "--config", tmp_path / "world.json5") as world,
        TandemProcess("agent", "a", "--config", tmp_path / "agent.json5") as a,
        TandemProcess("agent", "b", "--config", tmp_path / "agent.json5") as b,
    ):
        for part in (a, b, world):
            assert part.ended().status == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("agent", "a"), "--connect ENDPOINT is required"),
        (("world", "paper-1"), "--listen ENDPOINT is required"),
        (("agent", "a", "--keys", "{keys}/agent-a"), "--connect ENDPOINT is required"),
        (
            ("agent", "a", "--connect", "tls/127.0.0.1:7447"),
            "needs certificates: --keys DIR, or --config FILE",
        ),
        (
            ("agent", "a", "--connect", "tcp/127.0.0.1:7447", "--keys", "{keys}/agent-a"),
            "tcp/127.0.0.1:7447 is not encrypted; with --keys, use tls/127.0.0.1:7447",
        ),
        (
            ("agent", "b", "--connect", "tls/127.0.0.1:7447", "--keys", "{keys}/agent-a"),
            "agent-a is the folder of agent-a, not of agent-b",
        ),
        (("watch", "--keys", "{keys}/world"), "world is the folder of world, not of viewer"),
        (
            ("world", "paper-1", "--listen", "tls/127.0.0.1:7447", "--keys", "{keys}"),
            "choose one of its folders: agent-a, agent-b, router, viewer, world",
        ),
        (
            ("watch", "--keys", "nowhere"),
            "nowhere is not a participant's folder of keys; `tandem keys` creates such",
        ),
        (("watch", "--keys", "{keys}/viewer", "--config", "x"), "not allowed with argument"),
        (("watch", ".", "--keys", "{keys}/viewer"), "--keys: a recording needs no network"),
        (("run", "paper-1", "--in-process", "--secure"), "--secure: --in-process has no network"),
        (("watch", "--keys", "k" * 300), f"--keys: {'k' * 300}: cannot be read: File name too long"),
    ],
)
def test_flags_that_exclude_each_other_are_refused(
    arguments: tuple[str, ...], words: str, keys: Path
) -> None:
    refused(tandem(*(one.format(keys=keys) for one in arguments)), words)


# --- warnings -------------------------------------------------------------------------------------------


def test_listening_beyond_this_machine_without_keys_is_warned_about(keys: Path) -> None:
    where = free_endpoint().replace("127.0.0.1", "0.0.0.0")
    warning = f"listening without --keys at {where}: every machine that reaches it"
    with TandemProcess("world", "paper-1", "--listen", where) as world:
        world.until_prints("waiting for")
        assert world.err.startswith(f"tandem world: {warning}")
        assert world.err.count("\n") == 1
    with TandemProcess("world", "paper-1", "--listen", free_endpoint()) as world:
        world.until_prints("waiting for")
        assert world.err == ""
    where = free_endpoint("tls").replace("127.0.0.1", "0.0.0.0")
    with TandemProcess("world", "paper-1", "--listen", where, "--keys", keys / "world") as world:
        world.until_prints("waiting for")
        assert world.err == ""
