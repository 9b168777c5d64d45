"""Measurements for the figures of [Kuntz2015]."""

from __future__ import annotations

from lungaccess.problem.system import preset_text


def as_in_paper(preset: str) -> str:
    """Return the TOML text of a preset whose tubes do not bear the needle, which the paper does not count."""
    own_name = preset_text(preset).replace(f'name = "{preset}"', f'name = "{preset}, needle not counted"', 1)
    return own_name.replace("needle_preloaded = true", "needle_preloaded = false")
