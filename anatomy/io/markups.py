"""Points and curves that 3D Slicer has saved: `.mrk.json`, or by name out of a scene, `.mrml` or `.mrb`.

A reference names one of them: `scene.mrml#target`, `points.mrk.json#target`.
"""

import json
import re
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple, TypeVar
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np

from anatomy.base.errors import FileError, FrameError
from anatomy.base.files import read_text, reading, require_file
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.grid import ORTHONORMAL_TOLERANCE, freeze_arrays
from anatomy.io.frames import LPS_FROM, MOST_COORDINATE_MM

MASKS_TRANSFORMS = ("breathing tissue", "breathing devices")
"""Transforms of an exported breathing scene, by name: points below them are stored in the masks' phase."""
_REFERENCE = re.compile(r"(?P<file>.+?\.(?:mrml|mrb|json))#(?P<name>.+)", re.IGNORECASE | re.DOTALL)
_REMEDY = "Save the scene in 3D Slicer with its markups as .mrk.json"
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""How 3D Slicer packs bundles; other methods unpack far more at a time than is asked for."""
_LARGEST_BYTES = 1 << 28
"""A scene or markups in a bundle that unpack to more are not what 3D Slicer writes."""


@frozen_record
class ControlPoint:
    """A point of a markup and its frame `(4, 4)` LPS mm; oriented if that is not 3D Slicer's default."""

    label: str
    lps_from_point: Float
    oriented: bool

    def __post_init__(self) -> None:
        freeze_arrays(self, "lps_from_point", dtype=np.float64)

    @property
    def lps_mm(self) -> Float:
        """Its place, `(3,)` LPS mm."""
        return self.lps_from_point[:3, 3]


@frozen_record
class Markup:
    """A list of points or a curve, as 3D Slicer saved it; its points are those that are placed.

    The name is that in the scene, or in its file where there is no scene, and the kind "Fiducial", "Curve",
    "Line" or another of its types.
    """

    name: str
    kind: str
    points: tuple[ControlPoint, ...]

    @property
    def points_lps(self) -> Float:
        """Places `(N, 3)`, LPS mm."""
        return np.array([point.lps_mm for point in self.points]).reshape(-1, 3)


Kind = TypeVar("Kind", ControlPoint, Markup)


class Reference(NamedTuple):
    """A file of 3D Slicer, and the name of something in it."""

    file: Path
    name: str

    def __str__(self) -> str:
        return f"{self.name} of {self.file.name}"


def parse_reference(text: str) -> Reference | None:
    """Return file and name that a text such as `scene.mrml#target` states, None for any other text."""
    found = _REFERENCE.fullmatch(text)
    return None if found is None else Reference(Path(found["file"]), found["name"])


def read_named_point(reference: Reference) -> ControlPoint:
    """Return the point of a label, or the only point of a list or curve of that name.

    Raises FileError if the file is none of 3D Slicer's, or holds not exactly one such point, and FrameError
    if its frame is not stated, or a transform moves it that is not hardened.
    """
    markups = read_markups(reference.file)
    by_label = [point for each in markups for point in each.points if point.label == reference.name]
    by_name = [each.points[0] for each in markups if each.name == reference.name and len(each.points) == 1]
    return _only(by_label or by_name, reference, "point", [p.label for each in markups for p in each.points])


def read_named_pose(reference: Reference) -> Float:
    """Return the pose `(4, 4)` LPS mm of a point that has a direction of its own, see `read_named_point`.

    Raises FrameError if the point states no direction, or its frame is not that of a rigid body.
    """
    point = read_named_point(reference)
    if not point.oriented:
        raise FrameError(
            f"The point {reference} has no direction of its own",
            expected="a point whose orientation is that of a device, +z forward",
            remedy="Move a tip that `lungaccess export --slicer` writes: it keeps its direction",
        )
    return point.lps_from_point


def read_named_curve(reference: Reference) -> Markup:
    """Return the markup of a name with at least two points, see `read_named_point`."""
    markups = [each for each in read_markups(reference.file) if len(each.points) > 1]
    found = [each for each in markups if each.name == reference.name]
    return _only(found, reference, "curve", [each.name for each in markups])


def _only(found: list[Kind], reference: Reference, what: str, names: Iterable[str]) -> Kind:
    if len(found) == 1:
        return found[0]
    known = ", ".join(sorted({name for name in names if name})) or "none"
    raise FileError(
        f"{reference.file} has {len(found) or 'no'} {what}{'s' if len(found) > 1 else ''} {reference.name!r}",
        expected=f"exactly one, in the folder of the scene or below; it has {known}",
        remedy="Give it a name of its own in 3D Slicer, save the scene, and name it after the #",
    )


def read_markups(path: str | Path) -> tuple[Markup, ...]:
    """Return all lists of points and curves of a `.mrk.json`, a scene `.mrml` or a bundle `.mrb`.

    Raises FileError if it is none of these, or damaged, and FrameError if the frame of its points is not
    stated or not one of a rigid body, or a transform moves them that is not hardened.
    """
    path = require_file(path)
    kind = path.suffix.lower()
    if kind == ".mrml":

        def beside(name: str) -> str | None:
            file = path.parent / name
            return read_text(file) if file.resolve().is_relative_to(path.parent.resolve()) else None

        return _of_scene(read_text(path), beside, path)
    if kind == ".mrb":
        return _of_bundle(path)
    if kind == ".json":
        return tuple(_of_file(read_text(path), path))
    raise FileError(f"{path} is no file of 3D Slicer's", expected=".mrml, .mrb or .mrk.json", remedy=_REMEDY)


def _of_bundle(path: Path) -> tuple[Markup, ...]:
    with reading(path), zipfile.ZipFile(path) as bundle:
        members = {each.filename: each for each in bundle.infolist()}
        scenes = [name for name in members if name.endswith(".mrml")]
        if not scenes:
            raise FileError(f"{path} holds no scene", expected="a .mrml in the bundle", remedy=_REMEDY)
        folder, _, scene = min(scenes, key=lambda name: name.count("/")).rpartition("/")

        def text(name: str) -> str:
            member = f"{folder}/{name}" if folder else name
            content = b""
            if member in members and members[member].compress_type in _METHODS:
                with zipfile.Path(bundle, member).open("rb") as stream:
                    content = stream.read(_LARGEST_BYTES)
            if not 0 < len(content) < _LARGEST_BYTES:
                raise FileError(
                    f"{path} holds no {name} of a readable size and kind",
                    expected=f"less than {_LARGEST_BYTES >> 20} MiB, stored or deflated",
                    remedy=_REMEDY,
                )
            return content.decode("utf-8")

        return _of_scene(text(scene), text, path)


def _of_scene(text: str, read: Callable[[str], str | None], path: Path) -> tuple[Markup, ...]:
    """Return the markups of a scene; `read` returns the text of a file beside it, each of them once.

    What is not beside it is left out: a scene from elsewhere must not decide which files are read here.
    """
    lists: dict[str, list[Markup]] = {}
    with reading(path):
        if "<!DOCTYPE" in text or "<!ENTITY" in text:
            raise ValueError("it declares XML entities, which scenes never do")
        nodes = list(ElementTree.fromstring(text))
    by_id = {node.get("id", ""): node for node in nodes}
    markups: list[Markup] = []
    for node in nodes:
        stated = (node.get("references") or "").split(";")
        references = dict(each.split(":", 1) for each in stated if ":" in each)
        storage = by_id.get(references.get("storage", "").split(" ")[0])
        file = "" if storage is None else unquote(storage.get("fileName") or "")
        if not node.tag.startswith("Markups") or not file.endswith(".json"):
            continue
        if transform := references.get("transform"):
            moving = by_id.get(transform)
            name = "" if moving is None else moving.get("name", "")
            if name not in MASKS_TRANSFORMS:
                raise FrameError(
                    f"{node.get('name')!r} in {path} lies below the transform {name or transform!r}",
                    expected="points that are stored where they are shown",
                    remedy="Harden the transform in 3D Slicer's Data module, and save the scene again",
                )
        if file not in lists:
            content = read(file)
            lists[file] = [] if content is None else _of_file(content, path.parent / file)
        markups += [
            Markup(name=node.get("name") or each.name, kind=each.kind, points=each.points)
            for each in lists[file]
        ]
    return tuple(markups)


def _of_file(text: str, path: Path) -> list[Markup]:
    with reading(path):
        content = json.loads(text)
        listed = content.get("markups") if isinstance(content, dict) else None
        if not isinstance(listed, list) or not all(isinstance(each, dict) for each in listed):
            raise FileError(f"{path} holds no markups", expected="a .mrk.json of 3D Slicer", remedy=_REMEDY)
        return [_markup(each, path) for each in listed]


def _markup(content: dict[str, Any], path: Path) -> Markup:
    frame, unit = str(content.get("coordinateSystem", "")), content.get("coordinateUnits", "mm")
    if frame.lower() not in LPS_FROM:
        raise FrameError(
            f"{path} states the coordinate system {frame!r}", expected="LPS or RAS", remedy=_REMEDY
        )
    if unit != "mm":
        raise FileError(f"{path} has the unit {unit!r}", expected="mm", remedy=_REMEDY)
    placed = (p for p in content.get("controlPoints", []) if p.get("positionStatus", "defined") == "defined")
    points = tuple(_point(each, LPS_FROM[frame.lower()][:3, :3], path) for each in placed)
    return Markup(name=str(content.get("name", "")), kind=str(content.get("type", "")), points=points)


def _point(content: dict[str, Any], lps_from_frame: Float, path: Path) -> ControlPoint:
    label = str(content.get("label", ""))
    place = np.array(content["position"], dtype=np.float64)
    turn = content.get("orientation")
    rotation = lps_from_frame if turn is None else np.array(turn, dtype=np.float64).reshape(3, 3)
    near = (np.abs(place) <= MOST_COORDINATE_MM).all()
    if place.shape != (3,) or not near or not np.isfinite(rotation).all():
        raise FileError(
            f"The point {label!r} of {path} is not three finite numbers", expected="mm", remedy=_REMEDY
        )
    skew = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if not (skew <= ORTHONORMAL_TOLERANCE and np.linalg.det(rotation) > 0.0):
        raise FrameError(
            f"The orientation of the point {label!r} of {path} is no rotation (off by {skew:.2g})",
            expected="a right-handed frame of three unit vectors",
            remedy=_REMEDY,
        )
    pose = np.eye(4)
    pose[:3, :3] = rotation if turn is None else lps_from_frame @ rotation
    pose[:3, 3] = lps_from_frame @ place
    screen = LPS_FROM["ras"][:3, :3]
    plain = any(np.abs(pose[:3, :3] - each).max() < ORTHONORMAL_TOLERANCE for each in (screen, np.eye(3)))
    return ControlPoint(label=label, lps_from_point=pose, oriented=not plain)
