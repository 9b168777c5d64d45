"""How Sphinx builds these pages: `make docs`; every warning is an error."""

from __future__ import annotations

import importlib.metadata
import subprocess
import sys
from pathlib import Path

project = "lungaccess"
author = "The lungaccess contributors"
copyright = f"2026, {author}"
release = importlib.metadata.version("lungaccess")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"]
exclude_patterns = ["_build", "pictures"]
templates_path = ["_templates"]
html_theme = "furo"
html_title = "lungaccess"

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4

napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
autodoc_typehints = "none"
autodoc_member_order = "bysource"
autosummary_generate = True
autosummary_imported_members = False
nitpicky = False
# Docstrings name their sources as [Kuntz2015]; the bibliography is one page for all of them.
suppress_warnings = ["ref.citation", "ref.python"]

# The pictures of the gallery are those that its scripts make.
HERE = Path(__file__).resolve().parent
EXAMPLES = HERE.parent / "examples" / "run_all.py"
subprocess.run([sys.executable, str(EXAMPLES), str(HERE / "pictures")], check=True)
