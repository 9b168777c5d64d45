"""The server of the explorer: an address of this machine, a token, the page, a socket for its questions."""

import asyncio
import contextlib
import hmac
import logging
import re
import secrets
import shutil
import signal
import tempfile
import threading
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Iterator
from importlib import resources
from pathlib import Path
from typing import Any

from aiohttp import WSMsgType, web
from aiohttp.http_exceptions import HttpProcessingError

from anatomy.base.errors import FileError, LungaccessError, SettingsError
from anatomy.base.files import atomic_write
from anatomy.base.records import frozen_value
from lungaccess.showing.explorer.messages import error_message, frame
from lungaccess.showing.explorer.processes import NAMES, Process
from lungaccess.showing.explorer.questions import ANSWERS, CANCEL, MOST_CHARACTERS, number_of, read_message
from lungaccess.showing.explorer.worker import Asked, Ended, Given, KeptPlan, PatientSource
from lungaccess.showing.report.html.document import GLSL, asset, filled, scene_figure, slice_controls

HOST = "127.0.0.1"
TOKEN_BYTES = 24
DROPPED, DROPPED_BYTES = re.compile(r"[\w(][\w .()+-]{0,199}"), 1 << 20
"""Names that a dropped file and its folder may have, and how much of a file is in memory at a time."""
MOST_WAITING_BYTES = 1 << 27
"""Answers that wait for a page which does not read; it is closed when they become more."""
REQUEST_S = 5.0
"""A connection that sends no whole request within one to two times as long is closed: browsers take 1 ms."""
MOST_OPEN = 64
"""Questions of one page that may wait for answers: a page asks a handful at a time."""
FOLDERS = {"explorer": "lungaccess.showing.explorer", "report": "lungaccess.showing.report"}
"""Packages whose folder `page` holds modules and style sheets, by the first part of their addresses."""
KINDS = {".js": "text/javascript", ".css": "text/css"}
PAGE, OPENING = "explorer.html", "opening.html"
REACH = (
    '<label><input type="checkbox" id="reach-slices"> reach in the slices</label>'
    '<label><input type="checkbox" id="reach-scene"> reach in 3-D</label>'
)
CLICKS = "; a click chooses a nodule, a painted exit, or the place in the plane through the cross"

LOG = logging.getLogger(__name__)
"""Where aiohttp reports errors; malformed requests of strangers are none."""
LOG.addFilter(lambda record: _is_ours(record))

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


@frozen_value
class Address:
    """Where the explorer is: its port, and the token without which nothing is served."""

    port: int
    token: str

    @property
    def origin(self) -> str:
        """What the browser calls the place that the page comes from."""
        return f"http://{HOST}:{self.port}"

    @property
    def url(self) -> str:
        """What the user opens."""
        return f"{self.origin}/?token={self.token}"

    @property
    def cookie(self) -> str:
        """Name of the cookie: other ports of this machine have others."""
        return f"lungaccess-{self.port}"


class Page:
    """A page that is open: its socket, and the plans that it may ask about."""

    def __init__(self, socket: web.WebSocketResponse) -> None:
        self.socket = socket
        self.name = secrets.token_hex(8)
        self.plans: OrderedDict[str, KeptPlan] = OrderedDict()
        self.asked: dict[int, str] = {}
        self.outbox: asyncio.Queue[Given] = asyncio.Queue()
        self.waiting_bytes = 0
        self.closing: asyncio.Task[bool] | None = None

    def keep(self, plan: KeptPlan) -> None:
        """Keep a plan, and forget the oldest of too many."""
        self.plans[plan.digest] = plan
        self.plans.move_to_end(plan.digest)
        # Plans of a page that can still be appraised and exported; older ones are forgotten.
        while len(self.plans) > 200:
            self.plans.popitem(last=False)


class Explorer:
    """Serves the explorer of a patient, or the page that opens one, until it is stopped.

    Args:
        port: 0 for any free one.
    """

    def __init__(self, source: PatientSource, port: int = 0) -> None:
        self._source, self._port = source, port
        self._token = secrets.token_urlsafe(TOKEN_BYTES)
        self._folder = Path(tempfile.mkdtemp(prefix="lungaccess-explorer-"))
        self._pages: dict[str, Page] = {}
        self._files: OrderedDict[str, Path] = OrderedDict()
        self._processes: dict[str, Process] = {}
        self._runner: web.AppRunner | None = None
        self._served: set[object] = set()
        self._sweep: asyncio.Task[None] | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self.address: Address | None = None

    @property
    def processes(self) -> dict[str, int | None]:
        """Numbers of the processes that compute, by their names; None before they are needed."""
        return {name: each.pid for name, each in self._processes.items()}

    async def start(self) -> Address:
        """Begin to serve, and return where.  Raises SettingsError if the port is taken."""
        self._loop = asyncio.get_running_loop()
        self._loop.set_exception_handler(_without_failed_connections)
        self._processes = self._new_processes()
        app = web.Application(middlewares=[self._guard], client_max_size=1)
        app.router.add_get("/", self._index)
        app.router.add_get("/open", self._index)
        app.router.add_get("/socket", self._socket)
        app.router.add_get("/download/{ticket}/{name}", self._download)
        app.router.add_put("/drop/{folder}/{name}", self._drop)
        app.router.add_get("/{folder}/{name}", self._asset)
        self._runner = web.AppRunner(
            app, access_log=None, handle_signals=False, shutdown_timeout=1.0, logger=LOG
        )
        await self._runner.setup()
        site = web.TCPSite(self._runner, HOST, self._port)
        try:
            await site.start()
        except (OSError, OverflowError) as error:
            raise SettingsError(
                f"Port {self._port} cannot be used: {getattr(error, 'strerror', '') or error}",
                expected="a free port of this machine, from 1024 to 65535",
                remedy="Leave out --port, or choose another one",
            ) from error
        self._sweep = asyncio.create_task(self._close_half_open(self._runner))
        port = int(self._runner.addresses[0][1])
        self.address = Address(port=port, token=self._token)
        return self.address

    async def stop(self) -> None:
        """Close all pages, end all processes, and remove all files."""
        for page in list(self._pages.values()):
            with contextlib.suppress(ConnectionError):
                await page.socket.close(code=1001, message=b"the explorer has ended")
        if self._sweep is not None:
            self._sweep.cancel()
        if self._runner is not None:
            await self._runner.cleanup()
        for process in self._processes.values():
            await asyncio.to_thread(process.stop)
        shutil.rmtree(self._folder, ignore_errors=True)

    async def _close_half_open(self, runner: web.AppRunner) -> None:
        """Close connections that have sent no whole request since the last look: each takes a place."""
        waiting: set[web.RequestHandler] = set()
        while runner.server is not None:
            connections = set(runner.server.connections)
            self._served &= connections
            for each in connections - self._served:
                if each in waiting:
                    each.force_close()
            waiting = connections - self._served
            await asyncio.sleep(REQUEST_S)

    def _new_processes(self) -> dict[str, Process]:
        return {name: Process(self._source, self._folder, self._given) for name in NAMES}

    def _explore(self, source: PatientSource, asking: Page) -> None:
        """Explore another patient; pages that show the one before are closed, and cannot ask of this one."""
        self._source = source
        self._close_others(asking)
        ended, self._processes = self._processes, self._new_processes()
        for process in ended.values():
            threading.Thread(target=process.stop, daemon=True).start()

    def _renew(self, source: PatientSource, asking: Page) -> None:
        """Explore the patient as a person corrected it: the process that answers has done so already."""
        self._source = source
        self._close_others(asking)
        asking.plans.clear()
        for name, process in self._processes.items():
            if name != ANSWERS:
                process.renew(source)

    def _close_others(self, asking: Page) -> None:
        for page in self._pages.values():
            if page is not asking:
                page.closing = asyncio.create_task(page.socket.close(code=1012, message=b"another patient"))

    async def serve(self, started: Callable[[Address], None]) -> None:
        """Serve until SIGINT or SIGTERM comes; `started` is told the address."""
        ended = asyncio.Event()
        with _signalled(asyncio.get_running_loop(), ended):
            try:
                started(await self.start())
                await ended.wait()
            finally:
                await self.stop()

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Serve nothing but to the page itself, on this machine, with its token."""
        self._served.add(request.protocol)
        address = self._required_address
        allowed = request.headers.getall("Host", []) == [f"{HOST}:{address.port}"]
        allowed = allowed and request.headers.get("Origin", address.origin) == address.origin
        allowed = allowed and request.headers.get("Sec-Fetch-Site", "none") in ("none", "same-origin")
        by_cookie = _same(request.cookies.get(address.cookie, ""), address.token)
        by_query = request.path == "/" and _same(request.query.get("token", ""), address.token)
        if not allowed or not (by_cookie or by_query):
            return self._with_headers(web.Response(status=403, text=""))
        if by_query:
            response = web.Response(status=303, headers={"Location": "/"})
            response.set_cookie(address.cookie, address.token, httponly=True, samesite="Strict", path="/")
            return self._with_headers(response)
        try:
            answer = await handler(request)
        except web.HTTPException as error:
            answer = web.Response(status=error.status, text="")
        return answer if isinstance(answer, web.WebSocketResponse) else self._with_headers(answer)

    @property
    def _required_address(self) -> Address:
        if self.address is None:
            raise SettingsError("The explorer has not been started", remedy="Call start first")
        return self.address

    def _with_headers(self, response: web.StreamResponse) -> web.StreamResponse:
        """Allow the page its own modules, styles, pictures and socket, and nothing else."""
        socket = self._required_address.origin.replace("http", "ws", 1)
        response.headers.update(
            {
                "Content-Security-Policy": (
                    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
                    f"media-src blob:; connect-src 'self' {socket}; base-uri 'none'; form-action 'none'; "
                    "frame-ancestors 'none'"
                ),
                "Cache-Control": "no-store",
                "Cross-Origin-Opener-Policy": "same-origin",
                "Cross-Origin-Resource-Policy": "same-origin",
                "Referrer-Policy": "no-referrer",
                "X-Content-Type-Options": "nosniff",
                "X-Frame-Options": "DENY",
            }
        )
        return response

    async def _index(self, request: web.Request) -> web.StreamResponse:
        is_open = self._source.folder is not None and request.path == "/"
        template = asset(PAGE if is_open else OPENING, FOLDERS["explorer"])
        parts = {"scene": scene_figure(more_notes=CLICKS), "slice_controls": slice_controls(more=REACH)}
        return web.Response(text=filled(template, parts), content_type="text/html")

    async def _asset(self, request: web.Request) -> web.StreamResponse:
        folder, name = request.match_info["folder"], request.match_info["name"]
        if folder not in FOLDERS or name not in asset_names(folder):
            raise web.HTTPNotFound
        return web.Response(text=asset(name, FOLDERS[folder]), content_type=KINDS[Path(name).suffix])

    async def _download(self, request: web.Request) -> web.StreamResponse:
        file = self._files.get(request.match_info["ticket"])
        if file is None or not file.is_file() or file.name != request.match_info["name"]:
            raise web.HTTPNotFound
        return web.FileResponse(file, headers={"Content-Disposition": f'attachment; filename="{file.name}"'})

    async def _drop(self, request: web.Request) -> web.StreamResponse:
        """Copy a file that was dropped on the page beside the patients: a browser tells nobody its path."""
        names = request.match_info["folder"], request.match_info["name"]
        if not all(DROPPED.fullmatch(name) for name in names):
            raise web.HTTPBadRequest
        file = Path("dropped", *names).resolve()
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(file) as temporary, open(temporary, "wb") as stream:
                async for part in request.content.iter_chunked(DROPPED_BYTES):
                    await asyncio.to_thread(stream.write, part)
        except (OSError, FileError):
            raise web.HTTPInsufficientStorage from None
        return web.Response(text=str(file))

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        if "Origin" not in request.headers:
            raise web.HTTPForbidden
        socket = web.WebSocketResponse(max_msg_size=4 * MOST_CHARACTERS, heartbeat=30.0, compress=False)
        await socket.prepare(request)
        page = Page(socket)
        self._pages[page.name] = page
        sending = asyncio.create_task(self._send_all(page))
        try:
            async for message in socket:
                if message.type == WSMsgType.TEXT:
                    self._asked(page, message.data)
                elif message.type == WSMsgType.BINARY:
                    error = SettingsError("The message is binary", expected="JSON as text")
                    await socket.send_str(str(frame(error_message(None, error))))
        finally:
            sending.cancel()
            self._pages.pop(page.name, None)
            for process in self._processes.values():
                process.end(Ended(page=page.name))
        return socket

    def _asked(self, page: Page, text: str) -> None:
        """Pass a question on, or answer with the reason why not."""
        try:
            name, question = read_message(text)
            if name == CANCEL:
                worker = page.asked.get(question)
                if worker is not None:
                    self._processes[worker].end(Ended(page=page.name, number=question))
                return
            if len(page.asked) >= MOST_OPEN:
                raise SettingsError(f"{MOST_OPEN} questions are waiting", expected="fewer at a time")
            page.asked[question.id] = question.worker
            plan = page.plans.get(getattr(question, "plan", ""))
            self._processes[question.worker].ask(
                Asked(page=page.name, name=name, question=question, plan=plan)
            )
        except LungaccessError as error:
            sent = frame(error_message(number_of(text[: MOST_CHARACTERS + 1]), error))
            page.outbox.put_nowait(Given(page=page.name, number=-1, sent=sent, last=True))

    def _given(self, given: Given) -> None:
        """Take over a part of an answer, from the thread of a process."""
        if self._loop is not None and not self._loop.is_closed():
            with contextlib.suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._take, given)

    def _take(self, given: Given) -> None:
        page = self._pages.get(given.page)
        if page is None:
            return
        if given.plan is not None:
            page.keep(given.plan)
        if given.source is not None:
            (self._renew if given.renewed else self._explore)(given.source, page)
        if given.last:
            page.asked.pop(given.number, None)
        page.waiting_bytes += len(given.sent)
        page.outbox.put_nowait(given)
        if page.waiting_bytes > MOST_WAITING_BYTES and page.outbox.qsize() > 1:
            page.outbox = asyncio.Queue()
            page.waiting_bytes = 0
            del self._pages[page.name]
            page.closing = asyncio.create_task(page.socket.close(code=1013, message=b"too slow"))

    async def _send_all(self, page: Page) -> None:
        """Send what is answered, in its order."""
        while True:
            given = await page.outbox.get()
            with contextlib.suppress(ConnectionError):
                if given.file is not None:
                    address = f"/download/{self._ticket(given.file)}/{given.file.name}"
                    link = {"id": given.number, "answer": "link", "address": address}
                    await page.socket.send_str(str(frame(link)))
                if isinstance(given.sent, str):
                    await page.socket.send_str(given.sent)
                else:
                    await page.socket.send_bytes(given.sent)
                if given.source is not None and not given.renewed:
                    await page.socket.close(code=1012, message=b"another patient")
            page.waiting_bytes -= len(given.sent)

    def _ticket(self, file: Path) -> str:
        """Return the name under which a file can be fetched; the oldest of too many files is removed."""
        ticket = secrets.token_urlsafe(TOKEN_BYTES)
        self._files[ticket] = file
        while len(self._files) > 20:
            _ticket, old = self._files.popitem(last=False)
            shutil.rmtree(old.parent, ignore_errors=True)
        return ticket


def _is_ours(record: logging.LogRecord) -> bool:
    """Tell whether a record of the log speaks of the explorer, and not of a request that is none."""
    return not (record.exc_info and isinstance(record.exc_info[1], HttpProcessingError | ConnectionError))


def _without_failed_connections(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Report what goes wrong in the loop, but not that a connection could not be made or was lost."""
    if not isinstance(context.get("exception"), OSError):
        loop.default_exception_handler(context)


@contextlib.contextmanager
def _signalled(loop: asyncio.AbstractEventLoop, ended: asyncio.Event) -> Iterator[None]:
    """Let SIGINT and SIGTERM set an event; loops have handlers of their own for that, but not on Windows."""

    def end(*_signal: object) -> None:
        loop.call_soon_threadsafe(ended.set)

    before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _same(given: str, token: str) -> bool:
    """Compare in a time that does not tell how much is right."""
    return hmac.compare_digest(given.encode("utf-8", "surrogateescape"), token.encode())


def asset_names(folder: str) -> frozenset[str]:
    """Return the names of modules and style sheets in one of `FOLDERS`."""
    entries = (resources.files(FOLDERS[folder]) / "page").iterdir()
    made = [GLSL] if folder == "report" else []
    return frozenset([*made, *(each.name for each in entries if Path(each.name).suffix in KINDS)])
