"""Run a notebook's cells as IPython does, and print the HTML that each cell shows as a JSON list.

python notebook_runner.py NOTEBOOK
"""

from __future__ import annotations

import json
import sys

import nbformat
from IPython.core.interactiveshell import InteractiveShell
from traitlets.config import Config


def main(path: str) -> None:
    notebook = nbformat.read(path, as_version=4)
    shell = InteractiveShell(config=Config(HistoryManager={"enabled": False}))
    shown = []
    for cell in notebook.cells:
        if cell.cell_type == "code":
            result = shell.run_cell(cell.source)
            result.raise_error()
            data, _ = shell.display_formatter.format(result.result)
            shown.append(data.get("text/html", data["text/plain"]))
    json.dump(shown, sys.stdout)


if __name__ == "__main__":
    main(sys.argv[1])
