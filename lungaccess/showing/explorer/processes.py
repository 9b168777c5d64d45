"""The processes that compute for the explorer, from the side of the server."""

import contextlib
import multiprocessing
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from anatomy.base.child_process import end_with_parent
from anatomy.base.errors import AnatomyError
from lungaccess.showing.explorer.answers import Answers
from lungaccess.showing.explorer.messages import error_message, frame
from lungaccess.showing.explorer.questions import ANSWERS, CLICKS, PLANS, REACH
from lungaccess.showing.explorer.worker import Asked, Ended, Given, PatientSource, Worker

NAMES = (CLICKS, PLANS, REACH, ANSWERS)


def _work(connection: Connection, source: PatientSource, folder: Path) -> None:
    """Run in a process of its own."""
    end_with_parent()
    answers = Answers(source, folder)
    Worker(connection, answers.parts, answers.renew).run()


class Process:
    """One process from the side of the server; it is started when it is first asked, and again if it ends.

    Args:
        given: Gets each part of an answer, in a thread of this object.
    """

    def __init__(self, source: PatientSource, folder: Path, given: Callable[[Given], None]) -> None:
        self._source, self._folder, self._given = source, folder, given
        self._process: Any = None
        self._connection: Connection | None = None
        self._open: dict[tuple[str, int], None] = {}
        self._lock = threading.Lock()

    @property
    def pid(self) -> int | None:
        """Its number, None before it is started."""
        return None if self._process is None else self._process.pid

    def ask(self, asked: Asked) -> None:
        """Send a question."""
        self._open[asked.page, asked.question.id] = None
        self._send(asked)

    def renew(self, source: PatientSource) -> None:
        """Have the process take the patient again, of which a person corrected the masks."""
        self._source = source
        if self._connection is not None:
            self._send(source)

    def end(self, ended: Ended) -> None:
        """Say that an answer is no longer wanted."""
        if self._process is not None:
            self._send(ended)

    def _send(self, what: Asked | Ended | PatientSource) -> None:
        with self._lock:
            connection = self._connection or self._start()
            # Where the process has ended, the thread that reads notices it, and tells what was not answered.
            with contextlib.suppress(OSError):
                connection.send(what)

    def _start(self) -> Connection:
        context = multiprocessing.get_context("spawn")
        here, there = context.Pipe()
        self._process = context.Process(target=_work, args=(there, self._source, self._folder), daemon=True)
        self._process.start()
        there.close()
        self._connection = here
        threading.Thread(target=self._read, args=(here,), daemon=True).start()
        return here

    def _read(self, connection: Connection) -> None:
        while True:
            try:
                given: Given = connection.recv()
            except (EOFError, OSError):
                break
            if given.last:
                self._open.pop((given.page, given.number), None)
            self._given(given)
        with self._lock:
            if self._connection is connection:
                self._connection = None
        error = AnatomyError(
            "The process that answers has ended",
            expected="memory for a patient and its atlases",
            remedy="Ask again; close other programs if it ends again",
        )
        for page, number in list(self._open):
            self._open.pop((page, number), None)
            self._given(Given(page=page, number=number, sent=frame(error_message(number, error)), last=True))

    def stop(self) -> None:
        """End the process."""
        with self._lock:
            process, connection = self._process, self._connection
            self._connection = None
        self._open.clear()
        if connection is not None:
            connection.close()
        if process is not None:
            process.terminate()
            # A process that does not end by itself within this time is ended.
            process.join(5.0)
            if process.is_alive():
                process.kill()
                process.join()
