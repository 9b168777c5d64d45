"""Ask the package registry whether the stated platforms can install: `make resolve`.

For each platform and version of Python in matrix.toml, pip resolves the requirements of pyproject.toml from
wheels alone, without installing; only what has no metadata of its own is downloaded.  pip evaluates markers
for the interpreter that runs it, so they are evaluated here for the platform in question, those of indirect
requirements too.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any

from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
MATRIX = tomllib.loads((ROOT / "packaging" / "matrix.toml").read_text(encoding="utf-8"))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def environment(platform: dict[str, Any], python: str) -> dict[str, str]:
    """Return what markers see on a platform."""
    full = {"python_version": python, "python_full_version": f"{python}.0", "extra": ""}
    return {**default_environment(), **platform["markers"], **full}


def applying(lines: list[str], seen: dict[str, str]) -> list[str]:
    """Return requirements whose markers hold, without the markers."""
    found = []
    for each in map(Requirement, lines):
        if each.marker is None or each.marker.evaluate(seen):
            each.marker = None
            found.append(str(each))
    return found


def resolve(platform: dict[str, Any], python: str) -> str:
    """Return why pip cannot resolve the project on a platform, or ""."""
    seen = environment(platform, python)
    wanted = applying(PROJECT["dependencies"], seen)
    while True:
        report, said = pip_report(wanted, platform["tags"], python)
        if report is None:
            return said
        there = {canonicalize_name(each["metadata"]["name"]) for each in report}
        needed = [
            line for each in report for line in applying(each["metadata"].get("requires_dist", []), seen)
        ]
        missing = [line for line in needed if canonicalize_name(Requirement(line).name) not in there]
        if not missing:
            return ""
        wanted = sorted({*wanted, *missing})


def pip_report(wanted: list[str], tags: list[str], python: str) -> tuple[list[Any] | None, str]:
    """Return what pip would install, or None and the reason."""
    with tempfile.TemporaryDirectory() as temporary:
        report = Path(temporary, "report.json")
        words = [
            sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--quiet",
            "--disable-pip-version-check", "--only-binary=:all:", "--target", temporary,
            "--python-version", python, "--report", str(report), *(f"--platform={tag}" for tag in tags),
            *wanted,
        ]  # fmt: skip
        done = subprocess.run(words, capture_output=True, text=True)
        if done.returncode == 0:
            return json.loads(report.read_text(encoding="utf-8"))["install"], ""
    errors = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
    return None, (errors or done.stderr.splitlines() or ["pip said nothing"])[-1].removeprefix("ERROR: ")


def is_reachable() -> bool:
    """Say whether a registry answers at all: it always has a wheel of pip itself."""
    return pip_report(["pip"], ["any"], "3.11")[0] is not None


def table(found: dict[tuple[str, str], str]) -> str:
    """Return a table of the cells: "yes", or what is said of them below."""
    pythons = sorted({python for _platform, python in found}, key=lambda text: int(text.split(".")[1]))
    lines = ["| platform | " + " | ".join(pythons) + " |", "|---" * (1 + len(pythons)) + "|"]
    for platform in dict.fromkeys(name for name, _python in found):
        cells = [found.get((platform, python)) for python in pythons]
        words = [{None: "-", "": "yes"}.get(cell, "NO") for cell in cells]
        lines.append(f"| {platform} | " + " | ".join(words) + " |")
    reasons = [f"{platform}, Python {python}: {why}" for (platform, python), why in found.items() if why]
    return "\n".join(lines + reasons)


def main() -> int:
    """Resolve the cells that the command line asks for; exit code 1 if a stated one does not."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--platform", default="", help="only platforms whose name holds this text")
    parser.add_argument("--python", help="only this version, such as 3.12")
    asked = parser.parse_args()
    if not is_reachable():
        print("No package registry can be reached: nothing was resolved")
        return 0
    found = {}
    for platform in MATRIX["platform"]:
        for python in platform["python"] if asked.platform in platform["name"] else ():
            if asked.python in (None, python):
                found[platform["name"], python] = why = resolve(platform, python)
                print(f"{platform['name']}, Python {python}: {why or 'resolves'}", flush=True)
                if why and not is_reachable():
                    print("The package registry can no longer be reached: the rest was not resolved")
                    return 0
    print(table(found))
    return 1 if any(found.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
