"""A folder of masks from any source, described by a `patient.toml`."""

import json
import unicodedata
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from anatomy.base.errors import AnatomyError, FileError, SettingsError
from anatomy.base.files import read_toml, sha256
from anatomy.base.settings import parse, quantity, settings
from anatomy.base.words import did_you_mean
from anatomy.io.assembly import assemble, require_band, require_cost
from anatomy.io.frames import Frame, parse_point
from anatomy.io.images import image_stem, image_suffix, read_volume
from anatomy.io.mask_values import file_and_label, parse_labels
from anatomy.io.masks import MaskSource, read_masks
from anatomy.io.motion_files import MotionFile, read_motion
from anatomy.io.totalsegmentator import stored_names
from anatomy.lobes import LOBES, lobe_named
from anatomy.patient import PatientImages

DESCRIPTION = "patient.toml"
_ROLES = {name: name for name in ("lumen", "wall", "vessels", "lung", "fissures")} | {"nodule": "nodules"}
_Files = str | tuple[str, ...]


def _key(meaning: str) -> Any:
    return Field(description=meaning)


@settings
class PatientFile:
    """The keys of a `patient.toml`."""

    lumen: Annotated[_Files, _key("Airway lumen")]
    vessels: Annotated[_Files, _key("Arteries and veins")]
    lung: Annotated[
        _Files, _key("Both lungs, filled; or their lobes, if files or labels are named after them")
    ] = ()
    lobes: Annotated[Mapping[str, _Files], _key("Files by the name of their lobe")] = Field(
        default_factory=dict
    )
    wall: Annotated[_Files, _key("Airway wall")] = ()
    fissures: Annotated[_Files, _key("Fissures between lobes")] = ()
    fissure_band: Annotated[
        str, _key("Where fissures may lie, an obstacle: 3 to 49 % chance of lying beyond, 99 unknown")
    ] = ""
    nodule: Annotated[_Files, _key("Nodules")] = ()
    cost: Annotated[str, _key("Cost map with values in [0, 1] or infinity")] = ""
    name: Annotated[str, _key("How reports call the patient")] = ""
    frame: Annotated[Literal["", "ras", "lps"], _key("Frame of image files that state none")] = ""
    breath_hold: Annotated[
        Literal["", "inspiration", "expiration", "free-breathing"], _key("State of breathing")
    ] = ""
    targets: Annotated[tuple[str, ...], _key("Points with their frame")] = ()
    warnings: Annotated[tuple[str, ...], _key("What every command says again about these masks")] = ()
    thick_slices_mm: Annotated[
        float, quantity("Distance of slices too thick to show small airways and vessels", at_least=0.0)
    ] = 0.0
    large_radius_mm: Annotated[
        float,
        quantity("Radius from which a segmented vessel is an obstacle; thinner ones are costs", at_least=0.0),
    ] = 0.0
    vessel_border_mm: Annotated[
        tuple[float, ...], _key("Mean and standard deviation of how far true vessels reach out of their mask")
    ] = ()
    accepted: Annotated[
        tuple[str, ...], _key("Checks of the segmentation that failed and were overruled by --accept")
    ] = ()
    sources: Annotated[
        Mapping[str, str], _key("What other programs made of the masks, and the files they were in")
    ] = Field(default_factory=dict)
    motion: Annotated[MotionFile | None, _key("How the lungs breathe")] = None


def description_text(keys: Mapping[str, Any]) -> str:
    """Return a `patient.toml` with the keys that are not empty; three decimals, two in a list."""
    return "".join(f"{key} = {_toml(value)}\n" for key, value in keys.items() if value)


def _toml(value: Any, decimals: int = 3) -> str:
    if isinstance(value, Mapping):
        named = ((key if key.isidentifier() else _toml(key), _toml(each)) for key, each in value.items())
        return f"{{ {', '.join(f'{key} = {each}' for key, each in named)} }}"
    if isinstance(value, tuple | list):
        return f"[{', '.join(_toml(each, 2) for each in value)}]"
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str) else f"{value:.{decimals}f}"


def load_own_masks(description: Path) -> PatientImages:
    """Read the masks that a `patient.toml` names; paths are relative to its folder.

    `file#label` takes one label of a label map, by its value or its stored name, and `file#1,2` several.
    Raises SettingsError if the file is no TOML, a key is unknown or missing, or a value is not allowed, and
    AnatomyError, FileError, FrameError or GridMismatchError as `load_patient`.
    """
    keys = _read_description(description)
    folder = description.parent
    frame: Frame | None = keys.frame or None
    targets = tuple(parse_point(point) for point in keys.targets)
    masks = read_masks(list(_sources(keys, folder)), frame)
    hashes = {description.name: sha256(description)}
    maps = {}
    for key, fitted in {"cost": require_cost, "fissure_band": require_band}.items():
        if name := getattr(keys, key):
            maps[key] = fitted(read_volume(path := _named_file(folder, name), frame=frame), masks.grid)
            hashes[name] = sha256(path)
    images = assemble(
        masks,
        name=keys.name or folder.resolve().name,
        kind="masks",
        where=folder,
        **maps,
        targets_lps=targets,
        breath_hold=keys.breath_hold or None,
        vessel_border_mm=keys.vessel_border_mm,
        sources=hashes,
        accepted=keys.accepted,
        warnings=(*_warnings(keys), *keys.warnings),
    )
    return images if keys.motion is None else with_motion(images, keys.motion, description)


def motion_alone(description: Path) -> MotionFile | None:
    """Return the motion that a `patient.toml` names; None if it names anything else, such as masks.

    Raises SettingsError if the file is no TOML, or a key of the motion is unknown.
    """
    content = _read_content(description)
    return parse(MotionFile, content["motion"], description.name) if [*content] == ["motion"] else None


def with_motion(images: PatientImages, keys: MotionFile, description: Path) -> PatientImages:
    """Return images with a motion that a `patient.toml` in their folder names.

    Raises AnatomyError, FileError, FrameError or SettingsError as `load_own_masks`.
    """
    folder = description.parent
    hashes = {description.name: sha256(description)}
    hashes |= {name: sha256(_named_file(folder, name)) for name in keys.files if name}
    motion = read_motion(keys, folder, images.grid)
    return replace(images, motion=motion, sources={**images.sources, **hashes})


def thick_slices_mm(path: str | Path) -> float:
    """Return the distance of the slices of a patient's CT if its description marks them as thick, else 0.

    Raises SettingsError if there is a description, and it is wrong.
    """
    path = Path(path)
    description = path / DESCRIPTION if path.is_dir() else path
    if description.suffix != ".toml" or not description.is_file():
        return 0.0
    return _read_description(description).thick_slices_mm


def require_thin_slices(path: str | Path) -> None:
    """Refuse a patient whose masks were made from thick slices.

    Raises SettingsError if they were, or the description is wrong.
    """
    distance_mm = thick_slices_mm(path)
    if distance_mm:
        raise SettingsError(
            f"The masks of {path} were made from slices {distance_mm:.1f} mm apart",
            expected="slices that show small airways and vessels: at most 3 mm",
            remedy="Segment a thinner reconstruction; `lungaccess plan --thick-slices` plans all the same",
        )


def _warnings(keys: PatientFile) -> Iterator[str]:
    """Yield what the segmentation that wrote a description makes doubtful."""
    if keys.thick_slices_mm:
        yield (
            f"The masks were made from slices {keys.thick_slices_mm:.1f} mm apart: small airways and vessels "
            "are missing, so a path that looks free may not be."
        )
    if keys.accepted:
        yield (
            f"The segmentation failed its check of {', '.join(keys.accepted)}, and a person accepted that: "
            "look at the masks before planning."
        )
    if keys.sources:
        words = "; ".join(f"{name.replace('_', ' ')} from {source}" for name, source in keys.sources.items())
        yield f"Masks of other programs or people took the place of steps of the segmentation: {words}."


def _read_content(path: Path) -> dict[str, Any]:
    return read_toml(
        path,
        expected='lines such as lumen = "airway.nii.gz"',
        remedy="`lungaccess template patient` prints a complete file to start from",
    )


def _read_description(path: Path) -> PatientFile:
    try:
        return parse(PatientFile, _read_content(path), path.name)
    except SettingsError as error:
        raise SettingsError(
            error.found,
            expected=error.expected,
            remedy=f"Keys of a patient.toml are {', '.join(PatientFile.__dataclass_fields__)}; "
            "lumen, vessels, and lung or lobes are needed",
        ) from error


def _sources(keys: PatientFile, folder: Path) -> Iterator[MaskSource]:
    for key, role in _ROLES.items():
        for entry in _entries(getattr(keys, key)):
            yield _source(role, entry, folder)
    for name, files in keys.lobes.items():
        lobe = lobe_named(name)
        if not lobe:
            raise SettingsError(
                f"patient.toml names a lobe {name!r}",
                expected=f"one of {', '.join(LOBES.values())}",
                remedy='Write for instance: lobes = { "right upper" = "RUL.nii", "left lower" = "LLL.nii" }',
            )
        for entry in _entries(files):
            yield replace(_source("lobes", entry, folder), lobe=lobe)


def _entries(files: _Files) -> tuple[str, ...]:
    return (files,) if isinstance(files, str) else files


def _source(role: str, entry: str, folder: Path) -> MaskSource:
    """Return a mask source; a part of the lungs that is named after a lobe is that lobe."""
    file, label = file_and_label(folder / entry)
    name = entry.removesuffix(f"#{label}")
    path = _named_file(folder, name)
    if file == folder / entry:
        return _or_lobe(MaskSource(role=role, path=path), image_stem(path))
    labels = parse_labels(label)
    if labels is not None:
        return MaskSource(role=role, path=path, labels=labels)
    names = stored_names(path)
    values = tuple(value for value, stored in names.items() if stored == label)
    if not values:
        raise AnatomyError(
            f"{path} has no label named {label!r}",
            expected=f"one of {sorted(names.values())}" if names else "a file that names its labels",
            remedy=f"Write the label's value instead, as in {name}#1 or {name}#1,2",
        )
    return _or_lobe(MaskSource(role=role, path=path, labels=values), label)


def _or_lobe(source: MaskSource, name: str) -> MaskSource:
    lobe = lobe_named(name) if source.role == "lung" else 0
    return replace(source, role="lobes", lobe=lobe) if lobe else source


def _named_file(folder: Path, name: str) -> Path:
    """Return a file that the description names; if it is not there, say which file looks like it."""
    path = folder / name
    if path.is_file():
        return path
    there = [other.name for other in path.parent.glob("*") if image_suffix(other) and other.is_file()]
    if (folder / (slashed := name.replace("\\", "/"))).is_file():
        remedy = f"Write {slashed}: every system takes / between folders"
    elif unicodedata.normalize("NFC", path.name) in {unicodedata.normalize("NFC", each) for each in there}:
        remedy = "A file there has the same name with its letters composed otherwise (Unicode NFC or NFD): "
        remedy += "rename the file in plain letters"
    else:
        remedy = did_you_mean(path.name, there) or f"Images there: {', '.join(sorted(there)) or 'none'}"
    if path.is_symlink() or path.exists():
        remedy = f"It is a folder, or a link that leads nowhere. {remedy}"
    raise FileError(
        f"{DESCRIPTION} in {folder} names {name}, which is not there",
        expected="an existing file; names are relative to the folder of the patient.toml, or absolute",
        remedy=remedy,
    )
