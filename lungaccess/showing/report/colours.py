"""Colours that pictures and pages share: of the devices, and of what explains a missing plan."""

import json
import re
from importlib import resources
from types import MappingProxyType


def _device_colours() -> dict[str, str | list[str]]:
    """Return the colours of devices as the page's script states them, which is their one source."""
    script = (resources.files("lungaccess.showing.report") / "page" / "colours.js").read_text(
        encoding="utf-8"
    )
    stated = re.search(r"DEVICE_COLOURS = (\{.*?\});", script, re.DOTALL)
    if stated is None:
        raise RuntimeError("page/colours.js does not state DEVICE_COLOURS")
    return dict(json.loads(stated.group(1)))


DEVICE_COLOURS = MappingProxyType(_device_colours())
"""``#rrggbb`` of scope, outer, middle, inner, needle, needle_with_room, target and aim; others: a list."""

MISS, NEAREST, OTHER = "#8E24AA", "#2F8FD0", "#009E73"
"""The path that violates least, the plan to the nearest point, plans of other systems; on light and dark."""

START_COLOURS = MappingProxyType(
    {
        "clear": "#009E73", "a vessel": "#D81B60", "a fissure": "#785EF0", "an airway": "#1E88E5",
        "the pleura": "#B8860B", "needs several arcs": "#E69F00", "out of reach": "#B0B0B0",
    }
)  # fmt: skip
"""The colours by the keys of `FAILS`; those of structures are theirs in the charts of a page."""
