"""The link over TCP: other programs, pieces, delay, loss, reconnection, and programs that misbehave."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from anatomy.base.errors import SettingsError

pyigtl = pytest.importorskip("pyigtl", reason="pyigtl (extra `live`) is not installed")

from anatomy.io.openigtlink import pose_message  # noqa: E402
from lungaccess.showing.live import Link  # noqa: E402
from lungaccess.showing.live import link as link_module  # noqa: E402
from lungaccess.showing.live.link import LATE, REFUSED, UNREADABLE  # noqa: E402

PATIENCE = 2000
"""Rounds of a few milliseconds until something has to have happened."""


def pose_at(x: float) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


@pytest.fixture
def link() -> Iterator[Link]:
    with Link(port=0) as made:
        yield made


def until(done: Callable[[], bool], link: Link, found: list[object] | None = None) -> None:
    """Let a link work until something is so."""
    for _ in range(PATIENCE):
        if done():
            return
        received = link.poll(0.005)
        if found is not None:
            found += received
    raise AssertionError("it never happened")


def joined(link: Link, count: int = 1) -> list[socket.socket]:
    """Connect programs."""
    made = [socket.create_connection(("127.0.0.1", link.port)) for _ in range(count)]
    until(lambda: link.peers >= min(count, link_module.MOST_PEERS), link)
    return made


def test_it_listens_on_this_machine_alone(link: Link) -> None:
    assert link._server is not None and link._server.getsockname()[0] == "127.0.0.1"


def test_another_program_reads_and_writes(link: Link) -> None:
    """pyigtl's own client, which shares only the coding of messages with us."""
    link.greet_with((pose_message("Hello", pose_at(3.0), 1.0),))
    client = pyigtl.OpenIGTLinkClient("127.0.0.1", link.port)
    try:
        until(lambda: link.peers == 1, link)
        greeting = client.wait_for_message("Hello", timeout=5)
        assert np.allclose(greeting.matrix[:3, 3], [-3.0, 0.0, 0.0])
        link.send(pose_message("Tip", pose_at(7.0), 1.0))
        assert np.allclose(client.wait_for_message("Tip", timeout=5).matrix[:3, 3], [-7.0, 0.0, 0.0])
        found: list[object] = []
        client.send_message(pyigtl.TransformMessage(pose_at(-5.0), device_name="Back"), wait=False)
        until(lambda: len(found) == 1, link, found)
        assert found[0].name == "Back" and found[0].lps_from_device[0, 3] == pytest.approx(5.0)  # type: ignore[attr-defined]
    finally:
        client.stop()


def test_pieces_and_delay_change_nothing(link: Link) -> None:
    (other,) = joined(link)
    data, found = pose_message("A", pose_at(1.0), 1.0) + pose_message("B", pose_at(2.0), 2.0), []
    for byte in data:
        other.sendall(bytes([byte]))
        found += link.poll()
    until(lambda: len(found) == 2, link, found)
    assert [each.name for each in found] == ["A", "B"]


def test_a_lost_connection_is_forgotten_and_another_one_welcome(link: Link) -> None:
    """Half a message is lost with its connection, and the next connection begins anew."""
    data = pose_message("A", pose_at(1.0), 1.0)
    for number in range(3):
        (other,) = joined(link)
        other.sendall(data[:70])
        link.poll(0.005)
        other.close()
        until(lambda: link.peers == 0, link)
        assert link.counts.left == number + 1
    (other,) = joined(link)
    found: list[object] = []
    other.sendall(data)
    until(lambda: len(found) == 1, link, found)
    assert link.counts.joined == 4 and link.counts.received == 1


def test_who_sends_rubbish_loses_the_connection_and_the_others_do_not(link: Link) -> None:
    bad, good = joined(link, 2)
    bad.sendall(b"GET / HTTP/1.1\r\nHost: lungaccess\r\n\r\n" * 3)
    until(lambda: link.peers == 1, link)
    assert link.counts.dropped == {UNREADABLE: 1}
    found: list[object] = []
    good.sendall(pose_message("A", pose_at(1.0), 1.0))
    until(lambda: len(found) == 1, link, found)


def test_who_does_not_read_loses_messages_and_nobody_waits(
    link: Link, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(link_module, "MOST_WAITING", 10)
    slow = socket.socket()
    slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    slow.connect(("127.0.0.1", link.port))
    until(lambda: link.peers == 1, link)
    message = pose_message("A", pose_at(1.0), 1.0)
    for _ in range(PATIENCE * 30):
        link.send(message)
        if link.counts.dropped.get(LATE, 0) > 5:
            break
    assert link.counts.dropped[LATE] > 5 and link.peers == 1
    slow.settimeout(5.0)
    data = b""
    while len(data) < 3 * len(message):
        link.poll()
        data += slow.recv(1 << 16)
    assert data[: len(message)] == data[len(message) : 2 * len(message)] == message, "no half messages"


def test_a_reset_connection_is_no_error(link: Link) -> None:
    (other,) = joined(link)
    other.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\x00\x00\x00\x00\x00\x00\x00")
    other.close()
    message = pose_message("A", pose_at(1.0), 1.0)
    for _ in range(50):
        link.send(message)
        link.poll(0.002)
    assert link.peers == 0 and not link.counts.dropped


def test_too_many_programs_are_refused(link: Link) -> None:
    others = joined(link, link_module.MOST_PEERS + 1)
    until(lambda: link.counts.dropped.get(REFUSED) == 1, link)
    assert link.peers == link_module.MOST_PEERS
    for each in others:
        each.close()


def test_a_client_waits_for_its_server_and_comes_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_module, "RETRY_S", 0.01)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with Link(port=port, connects=True) as client:
        assert client.poll(0.01) == [] and client.peers == 0
        for number in (1, 2):
            with Link(port=port) as server:
                until(lambda: (server.poll(), client.peers == 1)[1], client)
                found: list[object] = []
                server.send(pose_message("A", pose_at(float(number)), 1.0))
                until(lambda: (server.poll(), len(found) == 1)[1], client, found)  # noqa: B023
            until(lambda: client.peers == 0, client)
        assert client.counts.joined == 2


def test_a_port_in_use_is_an_error_in_words(link: Link) -> None:
    for host in ("", "..", "\udcff", "a" * 300):
        for connects in (True, False):
            with pytest.raises(SettingsError, match="no name of a machine"):
                Link(host, 0, connects=connects)
    with pytest.raises(SettingsError, match="cannot be listened at"):
        Link(port=link.port)
    with pytest.raises(SettingsError, match="cannot be listened at"):
        Link(host="192.0.2.1", port=0)


def test_silent_programs_give_way_where_all_places_are_taken(
    link: Link, monkeypatch: pytest.MonkeyPatch
) -> None:
    silent = joined(link, link_module.MOST_PEERS)
    monkeypatch.setattr(link_module, "SILENT_S", 0.0)
    newcomer = socket.create_connection(("127.0.0.1", link.port))
    until(lambda: link.counts.dropped.get(link_module.GAVE_WAY) == 1, link)
    assert link.peers == link_module.MOST_PEERS
    for each in (*silent, newcomer):
        each.close()


def test_a_program_that_closes_before_it_has_read_all_is_not_lost(link: Link) -> None:
    (client,) = joined(link)
    link.send(*(pose_message("Tip", pose_at(n), 1.0) for n in range(50)))
    client.close()
    until(lambda: link.peers == 0, link)
    assert not link.counts.dropped and link.counts.left == 1
