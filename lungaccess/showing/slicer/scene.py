"""The scene file: one `.mrml` that makes 3D Slicer load every file of the folder."""

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Literal
from xml.sax.saxutils import quoteattr

from anatomy.base.records import frozen_value

Kind = Literal["Model", "MarkupsCurve", "MarkupsFiducial", "Segmentation"]

_SHOWN_AND_STORED: dict[Kind, tuple[str, str]] = {
    "Model": ("ModelDisplay", "ModelStorage"),
    "MarkupsCurve": ("MarkupsDisplay", "MarkupsJsonStorage"),
    "MarkupsFiducial": ("MarkupsFiducialDisplay", "MarkupsJsonStorage"),
    "Segmentation": ("SegmentationDisplay", "SegmentationStorage"),
}


@frozen_value
class Item:
    """One thing in a scene.

    Args:
        kind: Its node class, without `vtkMRML` and `Node`.
        colour: Red, green, blue in [0, 1].
    """

    kind: Kind
    name: str
    file: str
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)
    opacity: float = 1.0
    visible: bool = True


def scene(
    items: Iterable[Item], transforms: Mapping[str, str] = MappingProxyType({}), more: Sequence[str] = ()
) -> str:
    """Return the text of a scene; each item has a node, its display and its storage, stated to be LPS.

    `transforms` names the node of the transform that moves an item, by its file; `more` are further elements.
    """
    lines = ['<MRML version="Slicer5" userTags="">', *more]
    for number, item in enumerate(items, start=1):
        tags = _SHOWN_AND_STORED[item.kind]
        display, storage = (f"vtkMRML{tag}Node{number}" for tag in tags)
        moved = f"transform:{transforms[item.file]};" if item.file in transforms else ""
        node = {
            "id": f"vtkMRML{item.kind}Node{number}",
            "name": item.name,
            "selectable": "true",
            "references": f"display:{display};storage:{storage};{moved}",
        } | ({"curveType": "linear", "locked": "1"} if item.kind == "MarkupsCurve" else {})
        place = {"name": f"{item.name} storage", "fileName": item.file}
        place |= {} if item.kind == "Segmentation" else {"coordinateSystem": "LPS"}
        lines += [
            element(tags[0], {"id": display, **_look(item)}),
            element(tags[1], {"id": storage, **place}),
            element(item.kind, node),
        ]
    return "\n".join([*lines, "</MRML>", ""])


def _look(item: Item) -> dict[str, str]:
    colour = " ".join(f"{c:g}" for c in item.colour)
    look = {
        "name": f"{item.name} display",
        "color": colour,
        "opacity": f"{item.opacity:g}",
        "visibility": str(item.visible).lower(),
    }
    if item.kind == "Model":
        look |= {"visibility2D": "true", "backfaceCulling": "false", "scalarVisibility": "false"}
    elif item.kind == "Segmentation":
        look |= {"visibility3D": "false", "visibility2DFill": "true", "visibility2DOutline": "true"}
    else:
        fiducial = item.kind == "MarkupsFiducial"
        look |= {
            "selectedColor": colour,
            "glyphScale": "2" if fiducial else "0.5",
            "pointLabelsVisibility": str(fiducial).lower(),
            "propertiesLabelVisibility": str(not fiducial).lower(),
        }
    return look


def element(tag: str, attributes: Mapping[str, str]) -> str:
    """Return an element of a scene without content."""
    words = " ".join(f"{key}={quoteattr(value)}" for key, value in attributes.items())
    return f" <{tag} {words}></{tag}>"
