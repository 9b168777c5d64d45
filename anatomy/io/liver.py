"""Livers of the UNC Med-RAD collection: liver, nodules and three vessel trees, with starts and targets."""

from collections.abc import Mapping
from pathlib import Path

from anatomy.base.errors import AnatomyError
from anatomy.io.assembly import volumes_of
from anatomy.io.masks import MaskSource, read_masks
from anatomy.io.med_rad import numbered_nodules, text_poses
from anatomy.io.near_names import by_name, looks_like, plain, require_single
from anatomy.liver import LiverImages

LUMENS: Mapping[str, str] = {
    "hepatic-vein": "hepaticVein", "portal-vein": "portalVein", "hepatic-artery": "hepaticArtery",
}  # fmt: skip
"""What users call the vessels of a liver, and the names of their files."""


def is_liver(folder: Path) -> bool:
    """Tell whether a folder holds a liver of Med-RAD: at least one of its vessel trees by name."""
    return folder.is_dir() and any(plain(name) in by_name(folder) for name in LUMENS.values())


def load_liver(folder: Path) -> LiverImages:
    """Read a liver of Med-RAD.

    Raises AnatomyError if the liver or a vessel tree is missing or empty, and FileError or FrameError as
    `anatomy.io.load_patient`.
    """
    images = by_name(folder)
    files = {"liver": "liver", **LUMENS}
    missing = [name for name in files.values() if plain(name) not in images]
    if missing:
        unused = {name: path for name, path in images.items() if name not in map(plain, files.values())}
        likes = [(name, looks_like([name], unused)) for name in missing]
        said = "; ".join(f"{path.name} looks like {name}.nii.gz" for name, path in likes if path is not None)
        raise AnatomyError(
            f"{folder} looks like a liver of Med-RAD, but there is no {', '.join(missing)}. {said}",
            expected=", ".join(f"{name}.nii.gz" for name in files.values()),
            remedy="Rename the file; without one of these a needle would not be kept out of it",
        )
    sources = [MaskSource(role=role, path=images[plain(name)]) for role, name in files.items()]
    sources += numbered_nodules(images)
    doubles = require_single(folder, [source.path for source in sources])
    masks = read_masks(sources, extent=("liver",))
    volumes, empty = volumes_of(masks)
    poses, hashes = text_poses(folder, masks.grid)
    spacing_mm, thick = float(masks.grid.spacing_mm.max()), []
    # Slices farther apart miss vessels as wide as a needle.
    if spacing_mm > 3.0:
        thick = [
            f"The slices are {spacing_mm:.1f} mm apart: thin vessels are missing, so that a path that looks "
            "free may not be."
        ]
    return LiverImages(
        name=folder.resolve().name,
        kind="med-rad-liver",
        grid=masks.grid,
        liver=volumes["liver"],
        lumens={role: volumes[role] for role in LUMENS},
        nodules=volumes.get("nodules"),
        sources={**masks.sources, **hashes},
        warnings=(*thick, *doubles, *masks.statements, *empty),
        **poses,
    )
