"""One HTML file of templates, style sheet, scripts and data: complete in itself, nothing is fetched."""

import json
import os
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from anatomy.base.files import write_text
from lungaccess.showing.report.pack import script_text

GLSL = "glsl.js"
"""The module that is made of `shaders/`, so that programs are files of their own language."""
SHARED_MODULES = (
    "decode.js", "vectors.js", "colours.js", "surfaces.js", GLSL, "shaders.js", "layers.js", "picking.js",
    "solids.js", "scene.js", "gestures.js", "orbit.js", "voxels.js", "voxel_image.js", "slices.js",
    "slice_views.js", "structures.js", "slice_panel.js", "view_tools.js", "anatomy_page.js",
)  # fmt: skip
_IMPORT = re.compile(r"^import .*;\n", re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(async )?(function|class|const|let) )", re.MULTILINE)
_HOLE = re.compile(r"\{\{(\w+)\}\}")
_INCLUDE = re.compile(r'^#include "(.+)"$', re.MULTILINE)


def asset(name: str, package: str = "lungaccess.showing.report") -> str:
    """Return the text of a file; `GLSL` exports all of `shaders/` by name, with what each includes."""
    page = resources.files(package) / "page"
    if name != GLSL:
        return (page / name).read_text(encoding="utf-8")
    texts = {each.name: each.read_text(encoding="utf-8") for each in (page / "shaders").iterdir()}
    whole = {key: _INCLUDE.sub(lambda piece: texts[piece[1]], texts[key]) for key in sorted(texts)}
    return f"export const GLSL = {json.dumps(whole)};\n"


def bundle(names: Sequence[str]) -> str:
    """Return modules joined to one script, each after those that it imports.

    The modules import only each other and their names are all different, so that the lines of import and
    the words of export can be dropped.
    """
    return "\n".join(_EXPORT.sub("", _IMPORT.sub("", asset(name))) for name in names)


def filled(template: str, parts: Mapping[str, str]) -> str:
    """Return a template with each `{{name}}` replaced by the part of that name, in one pass.

    Raises KeyError if a part is missing.
    """
    return _HOLE.sub(lambda hole: parts[hole.group(1)], template)


def scene_figure(*, more_notes: str = "") -> str:
    """Return the figure of the 3-D view, with further words as HTML."""
    return filled(asset("scene.html"), {"more_notes": more_notes})


def slice_controls(*, more: str = "") -> str:
    """Return the controls of the slices, with further ones as HTML."""
    return filled(asset("slices.html"), {"more": more})


def write_page(
    path: str | os.PathLike[str],
    template: str,
    modules: Sequence[str],
    data: Mapping[str, Any],
    parts: Mapping[str, str],
) -> Path:
    """Write a page, all or nothing.

    Raises FileError if the file cannot be written.

    Args:
        template: Name of the page's own HTML, which goes into the body.
        modules: Scripts of this page, after `SHARED_MODULES`.
        data: Plain JSON values; the scripts find them in the element "report-data".
        parts: HTML for the holes of the template; "title" is plain text, escaped already.
    """
    whole = filled(
        asset("frame.html"),
        {
            "title": parts["title"], "style": asset("style.css"), "body": filled(asset(template), parts),
            "data": script_text(data), "script": bundle([*SHARED_MODULES, *modules]),
        },
    )  # fmt: skip
    write_text(os.fspath(path), whole)
    return Path(path)
