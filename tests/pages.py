"""The code blocks of the pages: README, CONTRIBUTING and docs.

A block of kind `console`, `python`, `toml`, `sql` or `json` is run or read by the tests; `text` is output. A
block that cannot run says why in a comment in the line before it: `<!-- not run: the reason -->`. A `toml`
block that begins with a comment such as `# errors.toml` is a file of that name for the blocks after it.
"""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md")))
RUN = ("console", "python", "toml", "sql", "json")
SHOWN = ("text",)
_FENCE = re.compile(
    r"^(?:<!-- not run: (?P<reason>[^\n]+?) -->\n)?```(?P<kind>[^\n]*)\n(?P<text>.*?)^```",
    re.DOTALL | re.MULTILINE,
)


@dataclass(frozen=True, kw_only=True)
class Block:
    """A fenced block: its kind, its text, and why it is not run, if it is not."""

    kind: str
    text: str
    not_run: str | None

    @property
    def commands(self) -> list[list[str]]:
        """The commands of a console block, as words without comments."""
        lines = self.text.replace("\\\n", " ").splitlines()
        return [words for line in lines if (words := shlex.split(line, comments=True))]


def name_of(page: Path) -> str:
    """Return the path of a page from the root, for the names of tests."""
    return page.relative_to(ROOT).as_posix()


def blocks(page: Path) -> list[Block]:
    """Return the blocks of a page in their order, without directives of Sphinx."""
    found = [
        Block(kind=match["kind"].strip(), text=match["text"], not_run=match["reason"])
        for match in _FENCE.finditer(page.read_text(encoding="utf-8"))
    ]
    return [block for block in found if not block.kind.startswith("{")]
