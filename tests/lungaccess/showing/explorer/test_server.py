"""The server: nothing without the token, nothing to others, no markup; its processes end with it."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import aiohttp
import pytest

from anatomy.base.errors import SettingsError
from lungaccess.showing.explorer import Explorer, PatientSource
from lungaccess.showing.explorer.server import FOLDERS, asset_names
from lungaccess.showing.explorer.worker import Given
from lungaccess.showing.report.html.document import asset
from lungaccess.showing.report.reach import COLOURS
from tests.lungaccess.showing.explorer.client import Client, opened, serving, source_of, with_client

NOBODY = PatientSource(folder=Path("nowhere"), system="lung-default")
"""What the server itself does needs no patient."""
PATHS = ("/", "/socket", "/explorer/explorer.js", "/report/style.css", "/download/x/plan.json", "/nowhere")


def served(
    headers: dict[str, str] | None = None, *, cookie: bool = False, paths: tuple[str, ...] = PATHS
) -> dict[str, Any]:
    """Return status, headers and text of paths."""

    async def run() -> dict[str, Any]:
        found = {}
        async with serving(NOBODY) as (_explorer, address), aiohttp.ClientSession() as session:
            sent = dict(headers or {})
            if cookie:
                sent["Cookie"] = f"{address.cookie}={address.token}"
            sent = {name: value.replace("ORIGIN", address.origin) for name, value in sent.items()}
            for path in paths:
                url = f"{address.origin}{path}".replace("TOKEN", address.token)
                async with session.get(url, headers=sent, allow_redirects=False) as answer:
                    found[path] = answer.status, dict(answer.headers), await answer.text()
        return found

    return asyncio.run(run())


@pytest.mark.parametrize(
    ("headers", "cookie"),
    [
        ({}, False),
        ({"Cookie": "lungaccess-1=x"}, False),
        ({"Host": "evil.example"}, True),
        ({"Host": "localhost:80"}, True),
        ({"Origin": "https://evil.example"}, True),
        ({"Origin": "null"}, True),
        ({"Sec-Fetch-Site": "cross-site"}, True),
        ({"Sec-Fetch-Site": "same-site"}, True),
    ],
)
def test_without_the_token_or_from_elsewhere_nothing_is_served(headers: dict[str, str], cookie: bool) -> None:
    """A name of another server that leads to this machine (DNS rebinding) has another Host."""
    for status, sent, text in served(headers, cookie=cookie).values():
        assert (status, text) == (403, "")
        assert "Set-Cookie" not in sent and "Server" not in sent or "lungaccess" not in sent.get("Server", "")


def test_a_wrong_token_in_the_address_is_refused() -> None:
    found = served(paths=("/?token=", "/?token=wrong", "/explorer/explorer.js?token=TOKEN", "/?token=TOKEN"))
    assert [status for status, _headers, _text in found.values()] == [403, 403, 403, 303]
    _status, headers, _text = found["/?token=TOKEN"]
    assert headers["Location"] == "/"
    assert all(word in headers["Set-Cookie"] for word in ("HttpOnly", "SameSite=Strict", "Path=/"))


def test_with_the_token_the_page_and_its_modules_are_served_and_kept_nowhere() -> None:
    found = served({"Origin": "ORIGIN", "Sec-Fetch-Site": "same-origin"}, cookie=True)
    assert [found[path][0] for path in PATHS] == [200, 400, 200, 200, 404, 404]
    for _status, headers, _text in found.values():
        assert headers["Cache-Control"] == "no-store"
        policy = headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy and "unsafe" not in policy and "*" not in policy
        assert headers["X-Content-Type-Options"] == "nosniff"
    assert found["/explorer/explorer.js"][1]["Content-Type"].startswith("text/javascript")


def test_the_legend_of_the_reach_has_the_colours_of_the_map() -> None:
    sheet = asset("explorer.css", FOLDERS["explorer"])
    for name, kind in (("direct", "direct arc"), ("unreachable", "unreachable")):
        assert f".swatch.{name} {{ background: {COLOURS[kind]}; }}" in sheet


@pytest.mark.parametrize(
    "path",
    [
        "/explorer/explorer.html", "/explorer/..%2fserver.py", "/report/%2e%2e/pack.py", "/tests/x.js",
        "/explorer/",
        "/download/..%2f..%2fetc/passwd", "/explorer/%00.js",
    ],
)  # fmt: skip
def test_other_files_are_not_served(path: str) -> None:
    status, _headers, text = served(cookie=True, paths=(path,))[path]
    assert status in (400, 404) and text in ("", "400: Bad Request") or status == 400


def test_only_one_address_of_this_machine_listens() -> None:
    async def run() -> list[Any]:
        async with serving(NOBODY) as (explorer, _address):
            assert explorer._runner is not None
            return list(explorer._runner.addresses)

    assert [host for host, _port in asyncio.run(run())] == ["127.0.0.1"]


def test_a_port_that_is_taken_is_said() -> None:
    async def run() -> None:
        async with serving(NOBODY) as (_explorer, address):
            second = Explorer(NOBODY, address.port)
            try:
                with pytest.raises(SettingsError, match="cannot be used"):
                    await second.start()
            finally:
                await second.stop()

    asyncio.run(run())


def test_the_socket_wants_the_origin_of_the_page() -> None:
    async def run(headers: dict[str, str]) -> int:
        async with serving(NOBODY) as (_explorer, address), aiohttp.ClientSession() as session:
            sent = headers | {"Cookie": f"{address.cookie}={address.token}"}
            with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
                await session.ws_connect(f"{address.origin}/socket", headers=sent)
            return refused.value.status

    assert asyncio.run(run({})) == 403
    assert asyncio.run(run({"Origin": "http://127.0.0.1:1"})) == 403


def test_the_page_has_no_style_and_no_script_of_its_own() -> None:
    """What the policy forbids would be left out by the browser without a word to the user."""
    assert "<script>" not in asset("explorer.html", FOLDERS["explorer"])
    for folder in FOLDERS:
        for name in (
            *asset_names(folder),
            *(("explorer.html",) if folder == "explorer" else ("scene.html",)),
        ):
            text = asset(name, FOLDERS[folder])
            assert 'style="' not in text and "onclick=" not in text
            assert not any(
                word in text for word in ("innerHTML", "eval(", "insertAdjacentHTML", "document.write")
            )
            assert not any(word in text for word in ("https://", "//cdn")) and text.count(
                "http://"
            ) == text.count("http://www.w3.org")


@pytest.mark.slow
def test_bad_messages_get_typed_errors_and_the_page_stays() -> None:
    async def talk(client: Client, _explorer: Explorer) -> None:
        for text in ("", "{}", "[1", '{"ask": "nothing", "id": 4}', '{"ask": "plan", "id": 5}'):
            await client.socket.send_str(text)
            message, _arrays = await client.next()
            assert message["answer"] == "error" and set(message["error"]) == {
                "kind",
                "found",
                "expected",
                "remedy",
            }
            assert message["error"]["kind"] == "SettingsError"
            assert message["id"] == {'{"ask": "nothing", "id": 4}': 4, '{"ask": "plan", "id": 5}': 5}.get(
                text
            )
        await client.socket.send_bytes(b"\x00")
        assert (await client.next())[0]["error"]["found"].startswith("The message is binary")
        await client.send("cancel")
        found = await client.ask("appraise", plan="unknown")
        assert found[-1][0]["answer"] == "error"

    with_client(NOBODY, talk)


@pytest.mark.slow
def test_a_patient_that_is_none_is_an_error_of_its_question() -> None:
    async def talk(client: Client, _explorer: Explorer) -> None:
        message = (await client.ask("patient"))[-1][0]
        assert message["answer"] == "error" and message["error"]["kind"] == "FileError"

    with_client(NOBODY, talk)


def is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.slow
def test_a_process_that_dies_is_told_and_started_again() -> None:
    async def talk(client: Client, explorer: Explorer) -> None:
        await client.ask("place", point=[0, 0, 0])
        first = explorer.processes["clicks"]
        assert first is not None
        number = await client.send("exits", target="nodule 1")
        os.kill(first, signal.SIGSTOP)
        asked = await client.send("patient")
        os.kill(first, signal.SIGKILL)
        found = [*await client.answers(asked), *await client.answers(number)]
        assert found[-1][0]["answer"] == "error"
        assert (await client.ask("patient"))[-1][0]["error"]["kind"] == "FileError"
        assert explorer.processes["clicks"] not in (None, first)

    with_client(NOBODY, talk)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_command_ends_with_its_processes(number: signal.Signals, patient: Path) -> None:
    start = "import sys; from lungaccess.cli.app import main; sys.exit(main())"
    cache = patient.parent / "cache"
    command = [
        sys.executable,
        "-c",
        start,
        "view",
        str(patient),
        "--system",
        "ultrathin",
        "--json",
        "--no-browser",
    ]
    process = subprocess.Popen([*command, "--cache", str(cache)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    address = ""
    while '"address"' not in address:
        address = process.stdout.readline()
        assert address or process.poll() is None
    url = address.split('"')[3]

    async def use() -> None:
        async with aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as session:
            async with session.get(url) as page:
                assert page.status == 200
            origin = url.split("/?")[0]
            async with session.ws_connect(f"{origin}/socket", headers={"Origin": origin}) as socket:
                client = Client(socket)
                assert (await client.ask("place", point=[0, 0, 0]))[-1][0]["answer"] == "end"
                await client.send("reach", around=[0, 0, 0], what_if={"system": "ultrathin"})

    asyncio.run(use())
    children = [
        int(each) for each in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    ]
    assert children
    process.send_signal(number)
    assert process.wait() == 0
    for _ in range(100):
        if not any(is_running(child) for child in children):
            break
        time.sleep(0.1)
    assert not any(is_running(child) for child in children)


@pytest.mark.slow
def test_two_pages_do_not_see_each_other(patient: Path) -> None:
    async def run() -> None:
        async with (
            serving(source_of(patient)) as (_explorer, address),
            opened(address) as one,
            opened(address) as two,
        ):
            ones = await one.send("place", point=[0, 0, 0])
            twos = await two.send("place", point=[10, 0, 0])
            found = [(await one.answers(ones))[0][0], (await two.answers(twos))[0][0]]
            assert [each["lps_mm"][0] for each in found] == [0.0, 10.0]

    asyncio.run(run())


def test_half_open_and_malformed_requests_are_closed_without_a_word(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("lungaccess.showing.explorer.server.REQUEST_S", 0.2)

    async def run() -> list[bytes]:
        async with serving(NOBODY) as (_explorer, address):
            ends = []
            for sent in (b"", b"GET / HTTP/1.1\r\nHost:", b"\x16\x03\x01\x00\xff\xfe nonsense\r\n\r\n"):
                reader, writer = await asyncio.open_connection("127.0.0.1", address.port)
                writer.write(sent)
                ends.append(reader)
            return [await asyncio.wait_for(reader.read(), 20.0) for reader in ends]

    assert asyncio.run(run())[:2] == [b"", b""]
    assert "Traceback" not in capfd.readouterr().err


def test_a_page_that_does_not_read_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lungaccess.showing.explorer.server.MOST_WAITING_BYTES", 1000)

    async def run() -> tuple[int, int]:
        async with serving(NOBODY) as (explorer, address), aiohttp.ClientSession() as session:
            headers = {"Cookie": f"{address.cookie}={address.token}", "Origin": address.origin}
            async with session.ws_connect(f"{address.origin}/socket", headers=headers):
                (page,) = explorer._pages.values()
                for _ in range(100):
                    explorer._take(Given(page=page.name, number=1, sent="x" * 100, last=False))
                return len(explorer._pages), page.outbox.qsize()

    assert asyncio.run(run()) == (0, 0)
