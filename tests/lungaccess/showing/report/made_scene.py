"""A page with a 3-D view of bodies that a test makes: what is where is known."""

from __future__ import annotations

import base64
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from lungaccess.showing.report.html import document
from lungaccess.showing.report.html.meshes import Look, packed_mesh
from tests.lungaccess.showing.report.browser import Browser

SIDE_PX = 300
DISTANCE_MM = 300.0
HALF_ANGLE = np.radians(15.0)
GROUND = (0.9, 0.92, 0.94)
MODULES = document.SHARED_MODULES[: document.SHARED_MODULES.index("voxel_image.js")]
PAGE = """<!DOCTYPE html><meta charset="utf-8"><link rel="icon" href="data:,">
<style>body {{ margin: 0 }} canvas {{ width: {side}px; height: {side}px; display: block }}</style>
<canvas id="scene"></canvas>
<script type="module">
{script}
window.made = {{
  open() {{ this.scene = new Scene(document.getElementById("scene")); }},
  async add(surfaces) {{ for (const packed of surfaces) await this.scene.addSurface(packed); }},
  tube(name, points, radius, colour) {{
    const solids = new Solids();
    solids.tube(points, radius, colour);
    this.scene.setSolids(name, solids);
  }},
  draw(camera) {{
    this.scene.fit();
    this.scene.draw(camera, {ground});
    return this.scene.canvas.toDataURL();
  }},
}};
window.lungaccessReport = {{ ready: Promise.resolve().then(() => window.made.open()) }};
</script>"""


def write_page(folder: Path) -> Path:
    """Write a page with an empty scene, `window.made`."""
    file = folder / "made.html"
    text = PAGE.format(side=SIDE_PX, script=document.bundle(MODULES), ground=json.dumps(GROUND))
    file.write_text(text, encoding="utf-8")
    return file


def body(mesh: trimesh.Trimesh, key: str, colour: str, opacity: float = 0.6) -> dict[str, Any]:
    """Return a surface as a page holds it."""
    look = Look(
        key=key, name=key.capitalize(), colour=colour, opacity=opacity, shown=True, cell_mm=1.0, most_faces=1
    )
    return packed_mesh(np.array(mesh.vertices), np.array(mesh.faces), look)


def camera(back: Any, up: Any = (0.0, 0.0, 1.0), centre: Any = (0.0, 0.0, 0.0)) -> dict[str, Any]:
    """Return a camera that looks at a point; `back` points from there to the camera."""
    back = np.asarray(back, dtype=float) / np.linalg.norm(back)
    eye = np.asarray(centre) + DISTANCE_MM * back
    return {
        "eye": eye.tolist(),
        "forward": (-back).tolist(),
        "up": list(map(float, up)),
        "distance": DISTANCE_MM,
    }


def axes_of(view: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return right, above and forward of a camera."""
    forward = np.array(view["forward"])
    right = np.cross(forward, view["up"])
    right /= np.linalg.norm(right)
    return right, np.cross(right, forward), forward


def ray(view: dict[str, Any], x: float, y: float) -> np.ndarray:
    """Return the unit direction through a place of the canvas, pixels of the page from its upper left."""
    right, above, forward = axes_of(view)
    across, up = 2 * x / SIDE_PX - 1, 1 - 2 * y / SIDE_PX
    direction = forward + np.tan(HALF_ANGLE) * (across * right + up * above)
    return np.asarray(direction / np.linalg.norm(direction))


def shown(page: Browser, surfaces: list[dict[str, Any]], view: dict[str, Any], **tubes: Any) -> np.ndarray:
    """Return the picture `(rows, columns, 3)` of bodies in a new scene; a tube: points, radius, colour."""
    page.run("for (const key of [...made.scene.surfaces.keys()]) made.scene.removeSurface(key)")
    page.run("for (const key of [...made.scene.solids.keys()]) made.scene.setSolids(key, null)")
    page.run("for (const key of [...made.scene.points.keys()]) made.scene.setPoints(key, null)")
    for name, (points, radius, colour) in tubes.items():
        page.run("made.tube(...arguments)", name, np.asarray(points).tolist(), radius, list(colour))
    page.run_async(f"made.add({json.dumps(surfaces)}).then(() => done(1))")
    return drawn(page, view)


def drawn(page: Browser, view: dict[str, Any]) -> np.ndarray:
    """Return the picture of the scene as it is."""
    return decoded(page.run("return made.draw(arguments[0])", view))


def decoded(url: str) -> np.ndarray:
    """Return the pixels of a PNG in a data URL."""
    data = base64.b64decode(url.split(",", 1)[1])
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), dtype=float)


def at(picture: np.ndarray, x: float, y: float) -> np.ndarray:
    """Return the colour at a place of the canvas, pixels of the page from its upper left."""
    scale = picture.shape[0] / SIDE_PX
    return np.asarray(picture[int(y * scale), int(x * scale)])
