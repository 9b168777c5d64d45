"""How Sphinx builds these pages: `make docs`; every warning is an error."""

from __future__ import annotations

import importlib
import importlib.metadata
import inspect
import re
import subprocess
import sys
from pathlib import Path

from sphinx.application import Sphinx

from anatomy.base.facade import public_names

project = "lungaccess"
author = "The lungaccess contributors"
copyright = f"2026, {author}"
release = importlib.metadata.version("lungaccess")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build", "_templates", "pictures"]
html_theme = "furo"
html_title = f"lungaccess {release}"
templates_path = ["_templates"]
html_sidebars = {
    "**": [
        "sidebar/brand.html", "sidebar/versions.html", "sidebar/search.html", "sidebar/scroll-start.html",
        "sidebar/navigation.html", "sidebar/scroll-end.html",
    ]
}  # fmt: skip

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4

napoleon_use_ivar = True
napoleon_use_rtype = False
autodoc_member_order = "bysource"
nitpicky = False
# Docstrings name their sources as [Kuntz2015]; the bibliography is one page for all of them.
suppress_warnings = ["ref.citation", "ref.python", "ref.ref"]

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
PACKAGES = HERE / "reference" / "packages"
OPTIONS = {"class": ["   :members:"], "function": [], "data": ["   :no-value:"]}


def write_reference() -> None:
    """Write a page of the reference for each package that states public names; a name is described once."""
    described: set[str] = set()
    files = [
        file for top in ("lungaccess", "stages", "anatomy") for file in (ROOT / top).rglob("__init__.py")
    ]
    for file in sorted(files, key=lambda path: len(path.parts), reverse=True):
        names = public_names(str(file))
        if "kernels" in file.parts or not names:
            continue
        package = ".".join(file.parent.relative_to(ROOT).parts)
        summary = (importlib.import_module(package).__doc__ or "").splitlines()[0]
        page = [package, "=" * len(package), "", summary, ""]
        for name, module in sorted(names.items()):
            value = getattr(importlib.import_module(module), name)
            kind = "class" if inspect.isclass(value) else "function" if inspect.isfunction(value) else "data"
            full = f"{module if kind == 'data' else value.__module__}.{name}"
            if full in described:
                page += [f"``{name}``: see :py:obj:`{full}`", ""]
                continue
            described.add(full)
            page += [f".. auto{kind}:: {full}", *OPTIONS[kind], ""]
        (PACKAGES / f"{package}.rst").write_text("\n".join(page), encoding="utf-8")


PACKAGES.mkdir(exist_ok=True)
for old in PACKAGES.iterdir():
    old.unlink()
write_reference()
sys.path.insert(0, str(ROOT))  # `sphinx-build` starts beside its own script, not in the project.
importlib.import_module("docs.write_tables").write_tables()

# The pictures of the gallery are those that its scripts make.
subprocess.run([sys.executable, str(ROOT / "examples" / "run_all.py"), str(HERE / "pictures")], check=True)


def tidy(_app: object, what: str, _name: str, value: object, _options: object, lines: list[str]) -> None:
    """Name sources in plain text: the bibliography is one page for all; leave out the docstring of a type."""
    if what == "data" and lines and lines[0] in (type(value).__doc__ or ""):
        lines.clear()
    lines[:] = [re.sub(r"^(\s*)\.\. \[(\w+)\]", r"\1\2", line) for line in lines]


def state_version(app: Sphinx, failure: Exception | None) -> None:
    """Write the version beside the pages, for packaging/publish_docs.py."""
    if failure is None and app.builder.format == "html":
        Path(app.outdir, "version.txt").write_text(f"{release}\n", encoding="utf-8")


def setup(app: Sphinx) -> None:
    """Connect to Sphinx."""
    app.connect("build-finished", state_version)
    app.connect("autodoc-process-docstring", tidy, priority=400)
