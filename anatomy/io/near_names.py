"""File names that are meant although they are spelt in another way, or nearly."""

import re
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from anatomy.base.errors import AnatomyError
from anatomy.io.images import image_stem, images_in, read_volume


def plain(name: str) -> str:
    """Return a name in lower case, of letters and digits alone."""
    return re.sub(r"[^a-z0-9]", "", name.lower())


def by_name(folder: Path) -> dict[str, Path]:
    """Return the images of a folder by their plain name, in the order of their names."""
    found: dict[str, Path] = {}
    for path in images_in(folder):
        found.setdefault(plain(image_stem(path)), path)
    return found


def require_single(
    folder: Path, chosen: Iterable[Path], others: Iterable[tuple[Path, Path]] = ()
) -> list[str]:
    """Refuse images that stand twice for one mask, and say which one is read of two that hold the same.

    Another image of the folder with the name of a `chosen` one, in other letters or with another ending, is
    its double. `others` are further pairs: an image that is read, and one that stands for the same mask.
    Raises AnatomyError if the two of a pair differ.
    """
    doubles = [
        (path, other)
        for path in dict.fromkeys(chosen)
        for other in images_in(folder)
        if other != path and plain(image_stem(other)) == plain(image_stem(path))
    ]
    said: dict[frozenset[Path], str] = {}
    for path, other in (*doubles, *others):
        one, two = read_volume(path), read_volume(other)
        if not one.grid.is_close(two.grid) or not np.array_equal(one.array, two.array):
            raise AnatomyError(
                f"{folder} holds {path.name} and {other.name}, which stand for one mask and differ",
                expected="one image for each mask",
                remedy="Remove or rename the one that is not meant, or write a patient.toml that names the "
                "other one",
            )
        words = f"{path.name} is read; {other.name} stands for the same mask and holds the same."
        said.setdefault(frozenset((path, other)), words)
    return list(said.values())


def looks_like(names: Iterable[str], images: Mapping[str, Path]) -> Path | None:
    """Return the image whose plain name is nearest to one of `names` or holds one, or None."""
    wanted = [plain(name) for name in names]
    # A name of four letters or fewer is part of many words.
    telling = [each for each in wanted if len(each) > 4]
    holding = [path for name, path in images.items() if any(each in name for each in telling)]
    if holding:
        return holding[0]
    # Least likeness (0 to 1) of a name that is offered for a missing one: a slip or two of the pen.
    near = [match for each in wanted for match in get_close_matches(each, images, n=1, cutoff=0.7)]
    return images[near[0]] if near else None
