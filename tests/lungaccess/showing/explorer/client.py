"""A page without a browser: it asks over the socket, and reads the answers."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import aiohttp

from lungaccess.showing.explorer import Address, Explorer, PatientSource
from lungaccess.showing.explorer.messages import read_frame

LAST = ("end", "error", "superseded")
Answer = tuple[dict[str, Any], dict[str, Any]]


@dataclass
class Client:
    """One page."""

    socket: aiohttp.ClientWebSocketResponse
    number: int = 0
    early: list[Answer] = field(default_factory=list)

    async def send(self, ask: str, **values: Any) -> int:
        """Send a question, and return its number."""
        self.number += 1
        await self.socket.send_str(json.dumps({"ask": ask, "id": self.number, **values}))
        return self.number

    async def next(self) -> Answer:
        """Return the next message."""
        received = await self.socket.receive()
        assert received.type in (aiohttp.WSMsgType.TEXT, aiohttp.WSMsgType.BINARY), received
        return read_frame(received.data)

    async def answers(self, number: int) -> list[Answer]:
        """Return all answers to a question; those to others are kept."""
        found = [each for each in self.early if each[0]["id"] == number]
        self.early = [each for each in self.early if each[0]["id"] != number]
        while not found or found[-1][0]["answer"] not in LAST:
            got = await self.next()
            (found if got[0]["id"] == number else self.early).append(got)
        return found

    async def ask(self, ask: str, **values: Any) -> list[Answer]:
        """Ask, and return all answers."""
        return await self.answers(await self.send(ask, **values))

    async def first(self, ask: str, **values: Any) -> Answer:
        """Ask, and return the first answer that is no progress."""
        found = await self.ask(ask, **values)
        return next(each for each in found if each[0]["answer"] != "progress")


@asynccontextmanager
async def serving(source: PatientSource) -> AsyncIterator[tuple[Explorer, Address]]:
    """Serve a patient as long as the context lasts."""
    explorer = Explorer(source)
    try:
        yield explorer, await explorer.start()
    finally:
        await explorer.stop()


@asynccontextmanager
async def opened(address: Address) -> AsyncIterator[Client]:
    """Open a page."""
    headers = {"Cookie": f"{address.cookie}={address.token}", "Origin": address.origin}
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(f"{address.origin}/socket", headers=headers, max_msg_size=0) as socket,
    ):
        yield Client(socket)


def with_client(source: PatientSource, talk: Callable[[Client, Explorer], Awaitable[None]]) -> None:
    """Serve a patient, open a page, and let it talk."""

    async def run() -> None:
        async with serving(source) as (explorer, address), opened(address) as client:
            await talk(client, explorer)

    asyncio.run(run())


def source_of(patient: Path, system: str = "ultrathin") -> PatientSource:
    """Return a patient whose cache is beside it."""
    return PatientSource(folder=patient, system=system, cache=patient.parent / "cache")
