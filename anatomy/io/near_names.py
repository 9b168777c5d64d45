"""File names that are meant although they are spelt in another way, or nearly."""

import re
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from pathlib import Path

from anatomy.io.images import image_stem, images_in

_SHORT = 4
"""A name of so few letters is part of many words."""
_NEAR = 0.7
"""Least likeness (0 to 1) of a name that is offered for a missing one: a slip or two of the pen."""


def plain(name: str) -> str:
    """Return a name in lower case, of letters and digits alone."""
    return re.sub(r"[^a-z0-9]", "", name.lower())


def by_name(folder: Path) -> dict[str, Path]:
    """Return the images of a folder by their plain name, in the order of their names."""
    found: dict[str, Path] = {}
    for path in images_in(folder):
        found.setdefault(plain(image_stem(path)), path)
    return found


def looks_like(names: Iterable[str], images: Mapping[str, Path]) -> Path | None:
    """Return the image whose plain name is nearest to one of `names` or holds one, or None."""
    wanted = [plain(name) for name in names]
    holding = [
        path for name, path in images.items() if any(len(each) > 4 and each in name for each in wanted)
    ]
    if holding:
        return holding[0]
    near = [match for each in wanted for match in get_close_matches(each, images, n=1, cutoff=_NEAR)]
    return images[near[0]] if near else None
