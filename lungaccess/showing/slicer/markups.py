"""Markups for 3D Slicer: curves with radius and pose at every point, and points with a name."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from anatomy.base.typed import Float
from lungaccess.plans.curves import DeviceCurve
from lungaccess.plans.plan import Plan
from lungaccess.plans.window import BreathingAim
from stages.scope.advisor import MARKUPS_SCHEMA

TARGET_COLOUR = (0.17, 0.63, 0.17)


def curve_markup(curve: DeviceCurve) -> dict[str, Any]:
    """Return the content of a `.mrk.json` file: an open curve in LPS mm.

    `orientation` holds the pose of the device at each point, row by row: its columns are the x, y and z
    axes of the device.  `Radius` is the radius of the device at each point.
    """
    points = [
        _point(number, f"{curve.name} {along:.1f} mm", frame[:3, 3]) | _orientation(frame)
        for number, (frame, along) in enumerate(
            zip(curve.lps_from_device, curve.arc_length_mm.tolist(), strict=True), start=1
        )
    ]
    radius = {
        "name": "Radius",
        "enabled": True,
        "units": "mm",
        "description": "outer radius of the device",
        "controlPointValues": curve.radius_mm.tolist(),
    }
    return _file("Curve", curve.name, points, curve.colour, labels=False, measurements=[radius])


def points_of_interest(plan: Plan) -> dict[str, Any]:
    """Return the content of a `.mrk.json` file: scope tip, tip of the tubes, exit and target, LPS mm.

    The tips keep the pose of their device, also where they are moved in 3D Slicer.
    """
    tips = {"scope tip": plan.scope.lps_from_scope_tip, "tube tip": plan.tube.lps_from_tip}
    places = {
        **{label: tip[:3, 3] for label, tip in tips.items()},
        "exit through the wall": plan.tube.exit.point_lps,
        "target": plan.target_lps,
    }
    return _fiducials("points", places, tips)


def aim_point(aim: BreathingAim) -> dict[str, Any]:
    """Return the content of a `.mrk.json` file: where devices end that were planned for a window, LPS mm."""
    return _fiducials("aim", {"aim of the devices": aim.point_lps})


def _fiducials(
    name: str, places: Mapping[str, Float], poses: Mapping[str, Float] = MappingProxyType({})
) -> dict[str, Any]:
    points = [
        _point(number, label, place) | (_orientation(poses[label]) if label in poses else {})
        for number, (label, place) in enumerate(places.items(), start=1)
    ]
    return _file("Fiducial", name, points, TARGET_COLOUR, labels=True, measurements=[])


def _orientation(pose: Float) -> dict[str, list[float]]:
    return {"orientation": pose[:3, :3].ravel().tolist()}


def _point(number: int, label: str, place: Float) -> dict[str, Any]:
    return {
        "id": f"{number}",
        "label": label,
        "position": place.tolist(),
        "locked": False,
        "visibility": True,
        "positionStatus": "defined",
    }


def _file(
    kind: str,
    name: str,
    points: list[dict[str, Any]],
    colour: tuple[float, float, float],
    *,
    labels: bool,
    measurements: list[dict[str, Any]],
) -> dict[str, Any]:
    display = {
        "visibility": True,
        "opacity": 1.0,
        "color": list(colour),
        "selectedColor": list(colour),
        "propertiesLabelVisibility": not labels,
        "pointLabelsVisibility": labels,
        "glyphType": "Sphere3D",
        "glyphScale": 2.0 if labels else 0.5,
    }
    markup = {
        "type": kind,
        "name": name,
        "coordinateSystem": "LPS",
        "coordinateUnits": "mm",
        "locked": True,
        "fixedNumberOfControlPoints": True,
        "controlPoints": points,
        "measurements": measurements,
        "display": display,
    }
    return {"@schema": MARKUPS_SCHEMA, "markups": [markup]}
