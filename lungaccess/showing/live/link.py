"""A link over TCP that several programs may join and leave: it sends to all, and reads from all.

Nothing here waits: `poll` does what can be done now.  Whoever is too slow loses messages, and whoever sends
what cannot be read loses the connection; both are counted.
"""

from __future__ import annotations

import selectors
import socket
import time
from collections import Counter, deque
from typing import Self

from anatomy.base.errors import FileError, SettingsError
from anatomy.base.records import frozen_value
from anatomy.io.openigtlink import Decoder, Received

HOST, PORT = "127.0.0.1", 18944
"""This machine alone, and the port of OpenIGTLink."""
RECEIVED_BYTES = 1 << 16
MOST_WAITING = 200
"""Messages kept for a program that does not read: ten seconds of poses at 20 Hz."""
RETRY_S = 0.5
"""Time between two attempts to reach a server."""
MOST_PEERS = 8
SILENT_S = 10.0
"""Where all places are taken, the program that has sent nothing for longest gives way after so long."""

LATE, UNREADABLE, LOST, REFUSED = "not read in time", "unreadable", "connection lost", "too many programs"
GAVE_WAY = "gave way to another program"


@frozen_value
class LinkCounts:
    """What a link has done so far.

    Args:
        joined, left: Connections.
        dropped: Messages and connections that were dropped, by reason.
    """

    sent: int
    received: int
    joined: int
    left: int
    dropped: dict[str, int]


class _Peer:
    """One connection."""

    def __init__(self, connection: socket.socket) -> None:
        self.connection, self.decoder = connection, Decoder()
        self.heard_s = time.monotonic()
        self.waiting: deque[bytes] = deque()
        self.begun = b""
        """What is left of the message that is being sent: it may not be dropped any more."""


class Link:
    """A server that programs connect to, or a client of one that it connects to again and again.

    Raises SettingsError if pyigtl is missing, the host is no name, or the address cannot be listened at.

    Args:
        host: Address to listen at or to connect to.
        port: 0 lets the system choose one to listen at; see `port`.
        connects: Whether it is a client.
    """

    def __init__(self, host: str = HOST, port: int = PORT, *, connects: bool = False) -> None:
        Decoder()  # Says at once if pyigtl is missing.
        try:
            is_name = bool(host.encode("idna"))  # An empty one would stand for all networks.
        except UnicodeError:
            is_name = False
        if not is_name:
            raise SettingsError(
                f"{host!r:.80} is no name of a machine",
                expected="a name or a number of the network, such as localhost or 127.0.0.1",
                remedy="Choose another --host",
            )
        self._host, self._stated_port, self._connects = host, port, connects
        self._peers: dict[socket.socket, _Peer] = {}
        self._counts: Counter[str] = Counter()
        self._dropped: Counter[str] = Counter()
        self._greeting: tuple[bytes, ...] = ()
        self._next_try = 0.0
        self._selector = selectors.DefaultSelector()
        self._server: socket.socket | None = None
        if not connects:
            self._listen()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def port(self) -> int:
        """The port."""
        return self._stated_port if self._server is None else int(self._server.getsockname()[1])

    @property
    def peers(self) -> int:
        """How many programs are connected."""
        return len(self._peers)

    @property
    def counts(self) -> LinkCounts:
        """What has been done so far."""
        dropped = Counter(self._dropped)
        for peer in self._peers.values():
            dropped += peer.decoder.dropped
        counts = {name: self._counts[name] for name in ("sent", "received", "joined", "left")}
        return LinkCounts(**counts, dropped=dict(sorted(dropped.items())))

    def greet_with(self, messages: tuple[bytes, ...]) -> None:
        """Keep messages that everyone gets who connects from now on."""
        self._greeting = messages

    def send(self, *messages: bytes) -> None:
        """Send messages to all who are connected, the oldest dropped first where one does not read."""
        for peer in self._peers.values():
            self._queue(peer, messages)
        self._flush()

    def poll(self, wait_s: float = 0.0) -> list[Received]:
        """Let programs join, send what waits, and return what has come, in its order.

        Args:
            wait_s: So long is waited if nothing comes.
        """
        if self._connects and not self._peers:
            self._connect(wait_s)
        self._flush()
        found: list[Received] = []
        if not self._selector.get_map():
            time.sleep(wait_s)
            return found
        for key, _events in self._selector.select(wait_s):
            if key.fileobj is self._server:
                self._accept()
            elif isinstance(key.fileobj, socket.socket) and key.fileobj in self._peers:
                found += self._read(self._peers[key.fileobj])
        self._counts["received"] += len(found)
        return found

    def close(self) -> None:
        """Close all connections."""
        for peer in list(self._peers.values()):
            self._leave(peer)
        if self._server is not None:
            self._selector.unregister(self._server)
            self._server.close()
            self._server = None
        self._selector.close()

    def _listen(self) -> None:
        family = socket.AF_INET6 if ":" in self._host else socket.AF_INET
        server = socket.socket(family, socket.SOCK_STREAM)
        try:
            server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            server.bind((self._host, self._stated_port))
            server.listen(MOST_PEERS)
        except (OSError, OverflowError) as error:
            server.close()
            raise SettingsError(
                f"{self._host}:{self._stated_port} cannot be listened at: {error}",
                expected="an address of this machine and a port that is free",
                remedy="Choose another --port, or end the program that uses it",
            ) from error
        server.setblocking(False)
        self._server = server
        self._selector.register(server, selectors.EVENT_READ)

    def _connect(self, wait_s: float) -> None:
        """Try to reach the server, not more often than every `RETRY_S`."""
        if time.monotonic() < self._next_try:
            return
        self._next_try = time.monotonic() + RETRY_S
        try:
            self._join(socket.create_connection((self._host, self._stated_port), timeout=max(wait_s, 0.05)))
        except OSError:
            return

    def _accept(self) -> None:
        if self._server is None:
            return
        try:
            connection, _address = self._server.accept()
        except OSError:
            return
        if len(self._peers) >= MOST_PEERS:
            silent = min(self._peers.values(), key=lambda peer: peer.heard_s)
            if time.monotonic() - silent.heard_s < SILENT_S:
                self._dropped[REFUSED] += 1
                connection.close()
                return
            self._dropped[GAVE_WAY] += 1
            self._leave(silent)
        self._join(connection)

    def _join(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        peer = self._peers[connection] = _Peer(connection)
        self._selector.register(connection, selectors.EVENT_READ)
        self._counts["joined"] += 1
        self._queue(peer, self._greeting)
        self._flush()

    def _queue(self, peer: _Peer, messages: tuple[bytes, ...]) -> None:
        peer.waiting += messages
        while len(peer.waiting) > MOST_WAITING:
            peer.waiting.popleft()
            self._dropped[LATE] += 1

    def _flush(self) -> None:
        """Send what can be sent without waiting."""
        for peer in list(self._peers.values()):
            try:
                while peer.begun or peer.waiting:
                    peer.begun = peer.begun or peer.waiting.popleft()
                    peer.begun = peer.begun[peer.connection.send(peer.begun) :]
                    if peer.begun:
                        break
                    self._counts["sent"] += 1
            except (BlockingIOError, InterruptedError):
                continue
            except (BrokenPipeError, ConnectionResetError):
                self._leave(peer)  # Whoever closes before all is read ends so.
            except OSError:
                self._dropped[LOST] += 1
                self._leave(peer)

    def _read(self, peer: _Peer) -> list[Received]:
        """Return the messages that have come from one program, which leaves if it has closed."""
        found: list[Received] = []
        try:
            data = peer.connection.recv(RECEIVED_BYTES)
            peer.heard_s = time.monotonic()
            found.extend(peer.decoder.feed(data))
        except (BlockingIOError, InterruptedError):
            return found
        except (FileError, OSError) as error:
            data = b""
            if not isinstance(error, ConnectionResetError):
                self._dropped[UNREADABLE if isinstance(error, FileError) else LOST] += 1
        if not data:
            self._leave(peer)
        return found

    def _leave(self, peer: _Peer) -> None:
        self._dropped += peer.decoder.dropped
        del self._peers[peer.connection]
        self._selector.unregister(peer.connection)
        peer.connection.close()
        self._counts["left"] += 1
