"""The processes that compute for the explorer: each holds the patient, and the latest question wins."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from anatomy.base.errors import AnatomyError, LungaccessError, SettingsError
from anatomy.base.records import frozen_value
from lungaccess.problem import System
from lungaccess.showing.explorer.messages import Frame, error_message, frame
from lungaccess.showing.explorer.questions import Question
from lungaccess.showing.report.html.volumes import CtFile

GONE = (EOFError, BrokenPipeError, ConnectionResetError)
"""A connection raises one of these when the server is gone."""
Key = tuple[str, str]
"""A page, and what it asked: a later question with the same key supersedes an earlier one."""


@frozen_value
class PatientSource:
    """Which patient is explored, and with what.

    Args:
        folder: Of the patient; None until one is chosen on the page.
        system: Name of the preset that is shown first, or of `own`.
        own (tuple of (path, System)): Systems from files, which the page offers beside the presets.
        cache: Folder of prepared anatomy and atlases; the default one if None.
        ct: CT for the slices.
        accept: Checks of the masks whose failure is accepted.
    """

    folder: Path | None
    system: str
    own: tuple[tuple[Path, System], ...] = ()
    cache: Path | None = None
    ct: CtFile | None = None
    accept: tuple[str, ...] = ()

    @property
    def patient(self) -> Path:
        """The folder of the patient.  Raises SettingsError if none is chosen yet."""
        if self.folder is None:
            raise SettingsError("No patient is open", remedy="Choose a CT or a patient on the page")
        return self.folder


@frozen_value
class KeptPlan:
    """A plan that a page may ask about: digest, JSON, and seconds, iterations and costs of its search."""

    digest: str
    text: str
    curve: tuple[tuple[float, float, float], ...] = ()


@frozen_value
class Asked:
    """A question of a page on its way to a process, with the plan that it is about."""

    page: str
    name: str
    question: Question
    plan: KeptPlan | None = None

    @property
    def key(self) -> Key:
        """What a later question of the same key supersedes."""
        return self.page, f"{self.name} {self.question.slot}"


@frozen_value
class _Along:
    """What goes with a part of an answer.

    Args:
        plan: A plan that the page may ask about.
        file: A file that the page may fetch.
        source: The patient that is explored from now on.
        renewed: Whether that is the same patient, of which a person corrected the masks.
    """

    plan: KeptPlan | None = None
    file: Path | None = None
    source: PatientSource | None = None
    renewed: bool = False


@dataclass(frozen=True)
class Part(_Along):
    """A part of an answer, made by what answers."""

    message: dict[str, Any]
    arrays: dict[str, Any] | None = None


@frozen_value
class Given(_Along):
    """A part of an answer on its way to the page.

    Args:
        sent: The message.
        last: Whether the question is answered with it.
    """

    page: str
    number: int
    sent: Frame
    last: bool = False


@frozen_value
class Ended:
    """Tells a process that a page is gone (number None), or no longer wants an answer."""

    page: str
    number: int | None = None


class Superseded(Exception):  # noqa: N818
    """A later question takes the place of the one that is being answered."""


class Turn:
    """What an answer may do within a slice of its work.

    Args:
        asked: The question that is being answered.
    """

    def __init__(self, worker: Worker, asked: Asked) -> None:
        self._worker, self._asked = worker, asked

    def send(self, part: Part) -> None:
        """Send a part at once."""
        self._worker.send(self._asked, part)

    def tell(self, what: str, share: float | None = None) -> None:
        """Send what is being done, and how much of it is done if that is known."""
        self.send(Part({"answer": "progress", "what": what, "share": share}))

    def check(self) -> None:
        """Raise Superseded if the answer is no longer wanted; may be called by several threads."""
        self._worker.check(self._asked)

    def give_way(self) -> None:
        """Let the other questions have a slice each, then `check`; from the main thread only."""
        self._worker.give_way()
        self.check()


Answering = Callable[[Asked, Turn], Iterator[Part | None]]
"""Answers a question in slices: it yields parts, or None between two slices of work."""


class Worker:
    """The loop of a process: it answers the questions of all pages by turns, a slice of each.

    Args:
        connection: To the process of the server.
        answering: See `Answering`.
        renew: Takes the patient again, of which a person corrected the masks in another process.
    """

    def __init__(
        self, connection: Connection, answering: Answering, renew: Callable[[PatientSource], None]
    ) -> None:
        self._connection, self._answering, self._renew = connection, answering, renew
        self._running: dict[Key, tuple[Asked, Iterator[Part | None]]] = {}
        self._now: list[Key] = []
        self._lock = threading.RLock()

    def run(self) -> None:
        """Answer until the server is gone."""
        try:
            while True:
                self._take_in(wait=not self._running)
                for key in list(self._running):
                    self._advance(key)
        except GONE:
            return

    def _take_in(self, *, wait: bool) -> None:
        while self._connection.poll(None if wait else 0):
            wait = False
            received = self._connection.recv()
            if isinstance(received, PatientSource):
                for key in list(self._running):
                    self._end(key)
                self._renew(received)
                continue
            if isinstance(received, Asked):
                self._end(received.key)
                self._running[received.key] = received, self._answering(received, Turn(self, received))
                continue
            for key, (asked, _iterator) in list(self._running.items()):
                if received.page == asked.page and received.number in (None, asked.question.id):
                    self._end(key)

    def _end(self, key: Key) -> None:
        """Forget a question that is being answered, and say so."""
        if key not in self._running:
            return
        asked, iterator = self._running.pop(key)
        if key not in self._now:
            iterator.close()  # type: ignore[attr-defined]
        self._send(asked, Part({"answer": "superseded"}), last=True)

    def _advance(self, key: Key) -> None:
        """Do one slice of an answer."""
        if key not in self._running or key in self._now:
            return
        asked, iterator = self._running[key]
        self._now.append(key)
        try:
            part = next(iterator)
            if part is not None and self._is_wanted(asked):
                self._send(asked, part)
        except StopIteration:
            self._finish(asked, Part({"answer": "end"}))
        except Superseded:
            pass
        except GONE:
            raise
        except LungaccessError as error:
            self._finish(asked, Part(dict(error_message(asked.question.id, error))))
        except MemoryError:
            self._finish(asked, _failed(asked, "There is not enough memory for this"))
        except Exception:  # A fault of one answer must not end the others.
            traceback.print_exc()
            self._finish(
                asked, _failed(asked, "This question made the program fail; its terminal says where")
            )
        finally:
            self._now.remove(key)

    def _finish(self, asked: Asked, part: Part) -> None:
        if self._is_wanted(asked):
            del self._running[asked.key]
            self._send(asked, part, last=True)

    def _is_wanted(self, asked: Asked) -> bool:
        running = self._running.get(asked.key)
        return running is not None and running[0] is asked

    def check(self, asked: Asked) -> None:
        """See `Turn.check`."""
        with self._lock:
            self._take_in(wait=False)
            if not self._is_wanted(asked):
                raise Superseded

    def give_way(self) -> None:
        """See `Turn.give_way`: a slice of what gave way itself is not begun within another one."""
        self._take_in(wait=False)
        if len(self._now) == 1:
            for key in list(self._running):
                self._advance(key)

    def send(self, asked: Asked, part: Part) -> None:
        """See `Turn.send`."""
        with self._lock:
            if self._is_wanted(asked):
                self._send(asked, part)

    def _send(self, asked: Asked, part: Part, *, last: bool = False) -> None:
        number, along = asked.question.id, {each.name: getattr(part, each.name) for each in fields(_Along)}
        sent = frame({"id": number, **part.message}, part.arrays)
        self._connection.send(Given(page=asked.page, number=number, sent=sent, last=last, **along))


def _failed(asked: Asked, found: str) -> Part:
    error = AnatomyError(found, expected="an answer", remedy="Ask something else, or close other programs")
    return Part(dict(error_message(asked.question.id, error)))
