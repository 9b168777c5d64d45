"""Explorers that are served, and windows that show them."""

from __future__ import annotations

import asyncio
import json
import threading
from typing import Any

from lungaccess.explorer import Address, Explorer, PatientSource
from tests.lungaccess.report import browser

PLANNED = "s.plan && s.plan.final && s.plan.appraised"


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
        """Wait until a condition of the state `s` holds, and return the state."""
        self.run_async(
            "const look = () => { const s = window.lungaccessReport.state();"
            f"if ({condition}) done(null); else setTimeout(look, 30); }}; look()"
        )
        return self.state()

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
        left, top = self.run(
            "const c = document.getElementById(arguments[0]); c.scrollIntoView({ block: 'center' });"
            "const box = c.getBoundingClientRect(); return [box.left, box.top]",
            canvas,
        )
        event = {"type": kind, "x": left + x, "y": top + y, "button": "left", "clickCount": 1}
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
