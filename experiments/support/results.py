"""Result files of the studies: tables "paper | ours" with their conditions, which RESULTS.md is made from.

A study's run is a `Result`; `write_result` stores it as FOLDER/SETTING/NAME.json, with NAME.png beside it.
Neither holds a path or the name of a machine.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import asdict, dataclass, field
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from anatomy.base.errors import FileError
from anatomy.base.files import atomic_write, require_writable_folder
from anatomy.base.records import frozen_value
from experiments.support.machine import cpu_seconds, machine

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PNG_BYTES = 150_000
PNG_DPI = (130, 110, 90, 70, 55)


@frozen_value
class Row:
    """One line of a table "paper | ours".

    Args:
        quantity: What was measured.
        ours, paper: The two values; None where there is none.  A share is a number of percent with the unit
            "%".
        unit: The unit of both.
        note: What differs, how often it was measured, where the paper says it.
    """

    quantity: str
    ours: float | None
    paper: float | None = None
    unit: str = ""
    note: str = ""


@dataclass(kw_only=True)
class Result:
    """What a study's run found; its clocks start when it is made, so make it first.

    Args:
        name: The module's name, which is also the name of the files.
        title: One line.
        source: The paper with its table or figure; empty for a study of our own.
        setting: "quick" or "full".
        conditions: What was measured on and how, words only.
        seeds: All seeds.
        rows: The table.
        not_reproduced: What of the paper was not reproduced, and why.
        progress: How far a run is that is not finished, such as "400 of 1600 runs"; empty for one that is.
        figure (matplotlib Figure): Stored as a PNG of at most 150 kB.
    """

    name: str
    title: str
    source: str = ""
    setting: str = "full"
    conditions: dict[str, str] = field(default_factory=dict)
    seeds: list[int] = field(default_factory=list)
    rows: list[Row] = field(default_factory=list)
    not_reproduced: list[str] = field(default_factory=list)
    progress: str = ""
    figure: Figure | None = None
    _began: tuple[float, float] = field(
        default_factory=lambda: (time.perf_counter(), cpu_seconds()), repr=False
    )

    def add(
        self, quantity: str, ours: float | None, paper: float | None = None, unit: str = "", note: str = ""
    ) -> None:
        """Add a row and print it."""
        row = Row(quantity=quantity, ours=ours, paper=paper, unit=unit, note=note)
        self.rows.append(row)
        print(" | ".join(cells(row)), flush=True)

    def to_mapping(self) -> dict[str, Any]:
        """Return plain JSON values, with the machine and the seconds since the result was made."""
        wall, cpu = self._began
        kept = {
            "name": self.name, "title": self.title, "source": self.source, "setting": self.setting,
            "conditions": self.conditions, "seeds": self.seeds, "not_reproduced": self.not_reproduced,
        }  # fmt: skip
        return {
            **kept,
            **({"progress": self.progress} if self.progress else {}),
            "rows": [{k: _finite(v) for k, v in asdict(row).items()} for row in self.rows],
            "figure": None if self.figure is None else f"{self.name}.png",
            "wall_s": round(time.perf_counter() - wall, 1),
            "cpu_s": round(cpu_seconds() - cpu, 1),
            "machine": machine(),
        }


def study_parser(doc: str) -> argparse.ArgumentParser:
    """Return a parser of what all studies understand: --quick, --seed, --results FOLDER.

    Args:
        doc: The docstring of the study's module.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="the small setting, minutes")
    parser.add_argument("--seed", type=int, default=1, help="first seed (default: %(default)s)")
    parser.add_argument(
        "--results", type=Path, default=Path("results"), metavar="FOLDER",
        help="where the files of the results go (default: %(default)s)",
    )  # fmt: skip
    return parser


def setting_of(options: argparse.Namespace) -> str:
    """Return "quick" or "full"."""
    return "quick" if options.quick else "full"


def write_result(result: Result, folder: str | Path) -> Path:
    """Store a result as FOLDER/SETTING/NAME.json and NAME.png, each in one step; return the JSON file.

    Raises:
        FileError: If the folder cannot be written, or the figure stays larger than 150 kB.
    """
    home = require_writable_folder(Path(folder) / result.setting)
    if result.figure is not None:
        picture = small_png(result.figure)
        with atomic_write(home / f"{result.name}.png") as temporary:
            temporary.write_bytes(picture)
    file = home / f"{result.name}.json"
    with atomic_write(file) as temporary:
        text = json.dumps(result.to_mapping(), indent=1, ensure_ascii=False, allow_nan=False)
        temporary.write_text(text + "\n", encoding="utf-8")
    return file


def small_png(figure: Figure) -> bytes:
    """Return a figure as a PNG of 256 colours, as fine as 150 kB allow."""
    from PIL import Image

    for dpi in PNG_DPI:
        raw, packed = BytesIO(), BytesIO()
        figure.savefig(raw, format="png", dpi=dpi, facecolor="white", metadata={"Software": None})
        Image.open(raw).convert("RGB").quantize(256).save(packed, format="PNG", optimize=True)
        if packed.tell() <= PNG_BYTES:
            return packed.getvalue()
    raise FileError(
        f"The figure takes {packed.tell() // 1000} kB", expected="at most 150 kB", remedy="Draw less in it"
    )


def number(value: float | None) -> str:
    """Return a value with three digits that count, or all digits of a whole number; "" for None.

    Examples:
        >>> number(0.012345), number(1234.5), number(96.0), number(None)
        ('0.0123', '1234', '96', '')
    """
    if value is None or not math.isfinite(value):
        return ""
    if value == round(value) and abs(value) < 1e7:
        return f"{value:.0f}"
    if abs(value) >= 1e6 or abs(value) < 1e-4:
        return f"{value:.2e}"
    return f"{value:.{max(2 - math.floor(math.log10(abs(value))), 0)}f}"


def cells(row: Row) -> tuple[str, str, str, str, str]:
    """Return a row's quantity, paper, ours, ratio of ours to the paper's, and note, as words."""
    unit = f", {row.unit}" if row.unit else ""
    return row.quantity + unit, number(row.paper), number(row.ours), _ratio(row.ours, row.paper), row.note


def _ratio(ours: float | None, paper: float | None) -> str:
    if ours is None or not paper:
        return ""
    return f"1 / {number(paper / ours)}" if 0.0 < abs(ours / paper) < 0.1 else number(ours / paper)


def _finite(value: Any) -> Any:
    if isinstance(value, str) or value is None:
        return value
    return float(value) if math.isfinite(value) else None
