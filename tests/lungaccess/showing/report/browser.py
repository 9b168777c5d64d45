"""A headless Chromium driven over chromedriver's own HTTP interface; nothing to install besides the two."""

from __future__ import annotations

import base64
import json
import shutil
import socket
import subprocess
import tempfile
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any, Self

FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--hide-scrollbars", "--disable-dev-shm-usage",
)  # fmt: skip
ELEMENT = "element-6066-11e4-a52e-4f735466cecf"
KEYS = {
    "ArrowLeft": "\ue012", "ArrowRight": "\ue014", "ArrowUp": "\ue013", "Home": "\ue011", "Tab": "\ue004",
    "Enter": "\ue007", "PageUp": "\ue00e",
}  # fmt: skip
STARTS = 200


def missing() -> str:
    """Return which of the programs is not installed; "" if none is missing."""
    lacking = [name for name in ("chromium", "chromedriver") if shutil.which(name) is None]
    return f"{' and '.join(lacking)} not installed (Debian: chromium, chromium-driver)" if lacking else ""


class Browser:
    """One window; close it with `with`.

    Args:
        width, height: Of the page, CSS pixels.
        phone: Whether the page is told that it is on a phone: touch, two pixels for one.
        dark: Whether the user prefers dark pages.
    """

    def __init__(
        self, width: int = 1440, height: int = 1000, *, phone: bool = False, dark: bool = False
    ) -> None:
        self._folder = tempfile.TemporaryDirectory()
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self._driver = subprocess.Popen(
            ["chromedriver", f"--port={port}"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        self._base = f"http://127.0.0.1:{port}"
        self._wait()
        profile = f"--user-data-dir={self._folder.name}/profile"
        options: dict[str, Any] = {
            "args": [*FLAGS, profile, f"--window-size={width},{height}"],
            "binary": shutil.which("chromium"),
        }
        if phone:
            metrics = {"width": width, "height": height, "pixelRatio": 2.0, "touch": True}
            options["mobileEmulation"] = {"deviceMetrics": metrics}
        logs = {"browser": "ALL", "performance": "ALL"}
        wanted = {"goog:chromeOptions": options, "goog:loggingPrefs": logs}
        made = self._send("POST", "/session", {"capabilities": {"alwaysMatch": wanted}})
        self._base += f"/session/{made['sessionId']}"
        scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.command("Emulation.setEmulatedMedia", {"features": scheme})

    @property
    def driver_pid(self) -> int:
        """Number of the process that starts the browser."""
        return self._driver.pid

    def _wait(self) -> None:
        for _ in range(STARTS):
            try:
                self._send("GET", "/status")
                return
            except (OSError, urllib.error.URLError):
                time.sleep(0.1)
        raise RuntimeError("chromedriver does not answer")

    def _send(self, method: str, path: str, content: Any = None) -> Any:
        data = None if content is None else json.dumps(content).encode()
        request = urllib.request.Request(self._base + path, data=data, method=method)
        request.add_header("Content-Type", "application/json")
        try:
            with urllib.request.urlopen(request) as answer:
                return json.load(answer)["value"]
        except urllib.error.HTTPError as error:
            raise RuntimeError(json.load(error)["value"]["message"]) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._send("DELETE", "")
        finally:
            self._driver.terminate()
            self._driver.wait()
            self._folder.cleanup()

    def open(self, page: Path | str) -> None:
        """Open a file or an address, and wait until it says that it is ready."""
        self._send("POST", "/timeouts", {"script": 300_000, "pageLoad": 300_000})
        self._send("POST", "/url", {"url": page if isinstance(page, str) else page.resolve().as_uri()})
        problem = self.run_async(
            "window.lungaccessReport.ready.then(() => done(''), (error) => done(String(error.stack)))"
        )
        if problem:
            raise RuntimeError(problem)

    def run(self, script: str, *arguments: Any) -> Any:
        """Return what a function body returns in the page."""
        return self._send("POST", "/execute/sync", {"script": script, "args": list(arguments)})

    def run_async(self, script: str) -> Any:
        """Return what a function body gives to `done` in the page."""
        text = f"const done = arguments[arguments.length - 1]; {script}"
        return self._send("POST", "/execute/async", {"script": text, "args": []})

    def state(self) -> dict[str, Any]:
        """Return the state of a report page."""
        return dict(self.run("return window.lungaccessReport.state()"))

    def press(self, selector: str, *keys: str) -> None:
        """Press keys while an element has the focus."""
        element = self._send("POST", "/element", {"using": "css selector", "value": selector})[ELEMENT]
        self.run("document.querySelector(arguments[0]).focus({ preventScroll: true })", selector)
        text = "".join(KEYS.get(key, key) for key in keys)
        self._send("POST", f"/element/{element}/value", {"text": text})
        self.frame()

    def frame(self) -> None:
        """Wait until the page has been drawn again."""
        self.run_async("requestAnimationFrame(() => requestAnimationFrame(() => done(null)))")

    def rest(self) -> None:
        """Wait until nothing moves: a slow machine then draws what is hidden, and slices, anew and well."""
        self.run_async(
            "const look = () => { const tools = window.lungaccessReport.state().view_tools;"
            " if (tools && tools.slow && tools.quality === 'moving') setTimeout(look, 30);"
            " else requestAnimationFrame(() => requestAnimationFrame(() => done(null))); };"
            " requestAnimationFrame(look)"
        )

    def messages(self) -> list[str]:
        """Return warnings and errors of the console since the last call."""
        entries = self._send("POST", "/se/log", {"type": "browser"})
        return [each["message"] for each in entries if each["level"] in ("WARNING", "SEVERE")]

    def requests(self) -> list[str]:
        """Return the addresses of all requests and sockets since the last call."""
        entries = (
            json.loads(each["message"])["message"]
            for each in self._send("POST", "/se/log", {"type": "performance"})
        )
        found = []
        for each in entries:
            if each["method"] == "Network.requestWillBeSent":
                found.append(each["params"]["request"]["url"])
            elif each["method"] == "Network.webSocketCreated":
                found.append(each["params"]["url"])
        return found

    def command(self, name: str, parameters: dict[str, Any]) -> Any:
        """Send a command of the DevTools protocol."""
        return self._send("POST", "/goog/cdp/execute", {"cmd": name, "params": parameters})

    def screenshot(self, path: Path) -> None:
        """Write a picture of the window."""
        path.write_bytes(base64.b64decode(self._send("GET", "/screenshot")))
