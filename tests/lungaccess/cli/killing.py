"""Commands that are ended at a stated share of their work, and what they leave."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil

START = "import sys; from lungaccess.cli.app import main; sys.exit(main())"
GONE_WITHIN_S = 30.0
MEASURED = ("timing", "wall_s", "cpu_s", "made_at", "resumed_layers", "time_s", "seconds")


def started(words: list[str]) -> subprocess.Popen[bytes]:
    """Start a command in a session of its own, so that all its processes are known."""
    command = [sys.executable, "-c", START, *words]
    return subprocess.Popen(
        command, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )


def members(session: int) -> list[psutil.Process]:
    """Return the processes of a session that live."""
    found = []
    for process in psutil.process_iter():
        try:
            if os.getsid(process.pid) == session and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process)
        except (psutil.Error, ProcessLookupError):
            continue
    return found


def _cpu_s(session: int) -> float:
    times = []
    for process in members(session):
        try:
            times.append(sum(process.cpu_times()[:2]))
        except psutil.Error:
            continue
    return sum(times)


def require_gone(session: int) -> None:
    """Fail if processes of a session stay."""
    until = time.monotonic() + GONE_WITHIN_S
    while (left := members(session)) and time.monotonic() < until:
        time.sleep(0.1)
    for each in left:
        each.kill()
    assert not left, f"processes stay: {left}"


def ended_at(words: list[str], cpu_s: float, end: signal.Signals) -> int | None:
    """Start a command, end its first process after so much processor time; None if it was done before.

    Returns the exit code.  Fails if a process stays.
    """
    process = started(words)
    while process.poll() is None and _cpu_s(process.pid) < cpu_s:
        time.sleep(0.02)
    running = process.poll() is None
    process.send_signal(end)
    _, said = process.communicate()
    require_gone(process.pid)
    assert b"Traceback" not in said, said.decode()
    return process.returncode if running else None


def outputs(folder: Path) -> dict[str, str]:
    """Return a hash of each file in a folder by name, without what is measured; hidden ones are left out."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(_content(path)).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    }


def _content(path: Path) -> bytes:
    if path.suffix != ".json":
        return path.read_bytes()
    return json.dumps(_plain(json.loads(path.read_text())), sort_keys=True).encode()


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items() if key not in MEASURED}
    return [_plain(each) for each in value] if isinstance(value, list) else value
