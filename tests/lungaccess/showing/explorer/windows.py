"""Explorers that are served, and windows that show them."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from typing import Any

from lungaccess.showing.explorer import Address, Explorer, PatientSource
from tests.lungaccess.showing.report import browser

PLANNED = "s.plan && s.plan.final && s.plan.appraised"
AT = """const [name, x, y] = arguments, canvas = document.getElementById(name);
const place = () => { const box = canvas.getBoundingClientRect(); return [box.left + x, box.top + y]; };
const isSeen = () => document.elementFromPoint(...place()) === canvas;
if (!isSeen()) window.scrollBy({ top: place()[1] - innerHeight / 2, behavior: 'instant' });
return isSeen() ? place() : null"""
"""Where a place of a canvas is in the window, scrolled if need be; null if it cannot be seen."""


class Served:
    """An explorer in a thread of its own."""

    def __init__(self, source: PatientSource) -> None:
        self.explorer = Explorer(source)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        self.address: Address = self._run(self.explorer.start())

    def _run(self, doing: Any) -> Any:
        return asyncio.run_coroutine_threadsafe(doing, self._loop).result()

    def stop(self) -> None:
        self._run(self.explorer.stop())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()


class Page(browser.Browser):
    """The explorer in a window."""

    def wait(self, condition: str) -> dict[str, Any]:
        """Wait until a condition of the state `s` holds, and return the state.

        Raises:
            AssertionError: If the condition fails, or does not hold within the time of a script; it says what
                is shown.
        """
        try:
            problem = self.run_async(
                "const look = () => { try { const s = window.lungaccessReport.state();"
                f"if ({condition}) done(''); else setTimeout(look, 30); }}"
                " catch (error) { done(error.stack); } }; look()"
            )
        except RuntimeError as error:
            raise AssertionError(f"not within its time: {condition}\n{self.shown()}") from error
        assert not problem, problem
        return self.state()

    def shown(self) -> str:
        """Return what the page says, for the message of a failure."""
        words = {name: self.text(name) for name in ("status", "headline-text", "exits-words", "target-error")}
        return json.dumps({"words": words, "console": self.messages(), "state": self.state()}, indent=1)

    def choose(self, element: str, value: str) -> None:
        """Put a value into a control."""
        self.run(
            "const e = document.getElementById(arguments[0]); e.value = arguments[1];"
            "e.dispatchEvent(new Event('change', { bubbles: true }))",
            element, value,
        )  # fmt: skip

    def click(self, element: str) -> None:
        self.run("document.getElementById(arguments[0]).click()", element)

    def text(self, element: str) -> str:
        return str(self.run("return document.getElementById(arguments[0]).textContent", element))

    def pointer(self, kind: str, canvas: str, x: float, y: float) -> None:
        """Move, press or release the mouse at a place of a canvas, in pixels from its upper left."""
        at = self.run(AT, canvas, x, y)
        assert at is not None, f"{x}, {y} of {canvas} cannot be seen"
        event = {"type": kind, "x": at[0], "y": at[1], "button": "left", "clickCount": 1}
        if kind == "mouseMoved":
            event |= {"buttons": 1}
        self.command("Input.dispatchMouseEvent", event)

    def press_at(self, canvas: str, x: float, y: float) -> None:
        for kind in ("mousePressed", "mouseReleased"):
            self.pointer(kind, canvas, x, y)

    def target(self, text: str) -> dict[str, Any]:
        """Choose a target, and wait for its plan."""
        self.run("document.getElementById('target-text').value = arguments[0]", text)
        self.run("document.getElementById('target-form').requestSubmit()")
        return self.wait(f"s.asked.target === {json.dumps(text)} && s.exits && s.exits.complete && {PLANNED}")


def press(page: browser.Browser, words: str) -> None:
    """Press the button with these words."""
    found = "[...document.querySelectorAll('button')].find((each) => each.textContent.includes(arguments[0]))"
    page.run(f"{found}.click()", words)


def explored(page: browser.Browser) -> None:
    """Wait until another page than the one before has the patient."""
    script = "return !window.before && Boolean(window.lungaccessExplorer && window.lungaccessExplorer.ready)"
    while not page.run(script):
        time.sleep(0.1)
