"""Answer queries of the benchmark synthetic-v1 with a planner that knows nothing of lungaccess.

    lungaccess benchmark synthetic-v1 make --phantoms adult-01 --out SYNTHETIC
    python examples/stranger/stranger.py SYNTHETIC/adult-01 thin-scope answers.json
    lungaccess benchmark synthetic-v1 score answers.json SYNTHETIC --only-answered

It reads the files of a case alone: masks, scope tips, device, targets.  From every published tip it lets the
inner tube out alone, an arc of known curvature that a needle in it lessens, and tries one arc of the needle
from its end to the target.
The arc with the largest clearance is handed in.  Clearances are looked up in distance maps of the masks.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np
import SimpleITK
from scipy.ndimage import distance_transform_edt, map_coordinates

ROTATIONS = np.linspace(0.0, 2.0 * np.pi, 36, endpoint=False)
INSERTIONS_MM = np.arange(6.0, 40.0, 2.0)
STEP_MM = 0.25
MOST_TRIED = 3000
"""Of the arcs that bend little enough, the shortest are looked at."""


def read_mask(path):
    """Return a mask `[i, j, k]`, its spacing, and the function from LPS mm to indices."""
    image = SimpleITK.ReadImage(str(path))
    lps_from_ijk = np.array(image.GetDirection()).reshape(3, 3) * image.GetSpacing()
    origin, inverse = np.array(image.GetOrigin()), np.linalg.inv(lps_from_ijk)
    array = SimpleITK.GetArrayFromImage(image).transpose(2, 1, 0) > 0
    return array, image.GetSpacing(), lambda points: (points - origin) @ inverse.T


def distance_maps(case):
    """Return lookups of the distance, mm, to the airway and to everything else that is forbidden."""
    lung, spacing, ijk = read_mask(case / "lung.nii.gz")
    masks = {name: read_mask(case / f"{name}.nii.gz")[0] for name in ("lumen", "wall", "vessels", "fissures")}
    airway = masks["lumen"] | masks["wall"]
    others = masks["vessels"] | masks["fissures"] | ~(lung | airway)
    half_diagonal = 0.5 * float(np.linalg.norm(spacing))

    def lookup(mask):
        distance = distance_transform_edt(~mask, sampling=spacing).astype(np.float32)
        # The distance to a voxel's centre overstates that to its corner by up to half a diagonal.
        return lambda points: (
            map_coordinates(distance, ijk(points).T, order=1, mode="nearest") - half_diagonal
        )

    return lookup(airway), lookup(others)


def bending_stiffness(shaft, diameter):
    """Return how stiff a shaft is at its tip, up to a factor that all shafts share."""
    slots = shaft["slotted_segments"][:1]
    plain = shaft["youngs_modulus_gpa"] * (diameter**4 - shaft["inner_diameter_mm"] ** 4)
    return plain * (slots[0]["stiffness_factor"] if slots else 1.0)


def curvature_ahead(device):
    """Return the curvature of the inner tube ahead of the outer one, shared with a needle by stiffness."""
    tube, needle = device["tubes"]["inner"], device["needle"]
    own = bending_stiffness(tube, tube["outer_diameter_mm"])
    within = bending_stiffness(needle, needle["diameter_mm"]) if device.get("needle_preloaded") else 0.0
    return tube["precurvature_per_mm"] * own / (own + within)


def arc_poses(poses, roll, curvature, length):
    """Return where arcs end that begin at poses (N, 4, 4): turn about +z, then bend towards +x."""
    roll, curvature, length = np.broadcast_arrays(roll, curvature, length)
    motion = np.zeros((len(roll), 4, 4))
    angle, small = curvature * length, np.maximum(curvature, 1e-9)
    c, s, ca, sa = np.cos(roll), np.sin(roll), np.cos(angle), np.sin(angle)
    side, along = (1.0 - ca) / small, np.where(curvature > 1e-9, sa / small, length)
    motion[:, 0] = np.stack([c * ca, -s, c * sa, c * side], axis=1)
    motion[:, 1] = np.stack([s * ca, c, s * sa, s * side], axis=1)
    motion[:, 2] = np.stack([-sa, np.zeros_like(sa), ca, along], axis=1)
    motion[:, 3, 3] = 1.0
    return poses @ motion


def points_on_arc(pose, roll, curvature, length):
    """Return points of one arc, `STEP_MM` apart, and their lengths."""
    along = np.linspace(0.0, length, max(2, int(np.ceil(length / STEP_MM)) + 1))
    frames = arc_poses(np.repeat(pose[None], len(along), axis=0), roll, curvature, along)
    return frames[:, :3, 3], along


class Planner:
    """Tries all tips, rotations and insertions at once, for one device in one patient."""

    def __init__(self, case, device):
        tips = json.loads((case / f"tips-{device['name']}.json").read_text())["tips"]
        self.tube, self.needle, margins = device["tubes"]["inner"], device["needle"], device["margins"]
        margin = margins["segmentation_margin_mm"] + margins["registration_margin_mm"]
        self.tube_mm = 0.5 * self.tube["outer_diameter_mm"] + margin
        self.needle_mm = 0.5 * self.needle["diameter_mm"] + margin
        self.airway_mm, self.others_mm = distance_maps(case)
        grid = np.meshgrid(np.arange(len(tips)), ROTATIONS, INSERTIONS_MM, indexing="ij")
        self.tip, self.rotation, self.insertion = (each.ravel() for each in grid)
        poses = np.array([tip["lps_from_tip"] for tip in tips])
        self.curvature = curvature_ahead(device)
        self.starts = arc_poses(poses[self.tip], self.rotation, self.curvature, self.insertion)
        self.tip_poses = poses
        # The end of the tube must be in tissue: clear of the airway and of everything else.
        ends = self.starts[:, :3, 3]
        self.usable = (self.airway_mm(ends) > 0.5) & (self.others_mm(ends) > self.tube_mm)

    def answer(self, target):
        """Return scope, tubes and needle of the best arc to a target `(3,)`, or None."""
        local = np.einsum("nji,nj->ni", self.starts[:, :3, :3], target - self.starts[:, :3, 3])
        sideways = np.hypot(local[:, 0], local[:, 1])
        curvature = 2.0 * sideways / np.maximum((local**2).sum(axis=1), 1e-9)
        angle = 2.0 * np.arctan2(sideways, local[:, 2])
        length = np.where(curvature > 1e-9, angle / np.maximum(curvature, 1e-9), local[:, 2])
        limit = np.radians(self.needle["max_angle_from_start_deg"])
        fits = self.usable & (local[:, 2] > 0.0) & (curvature < self.needle["max_curvature_per_mm"])
        fits &= (angle < limit) & (length > 8.0) & (length < self.needle["max_length_mm"])
        candidates = np.flatnonzero(fits)
        best, widest = None, 0.0
        for n in candidates[np.argsort(length[candidates])][:MOST_TRIED]:
            roll = float(np.arctan2(local[n, 1], local[n, 0]))
            spare = self.spare_mm(n, roll, float(curvature[n]), float(length[n]))
            if spare > widest:
                best, widest = (int(n), roll, float(curvature[n]), float(length[n])), spare
        return None if best is None else self.as_json(*best)

    def spare_mm(self, n, roll, curvature, length):
        """Return how much more room than needed an arc and the tube before it have, mm."""
        points, along = points_on_arc(self.starts[n], roll, curvature, length)
        spare = float((self.others_mm(points) - self.needle_mm).min())
        beyond = points[along >= self.needle["exit_exemption_mm"] - STEP_MM]
        if spare <= 0.0 or (len(beyond) and (self.airway_mm(beyond) - self.needle_mm).min() <= 0.0):
            return 0.0
        tip = self.tip_poses[self.tip[n]]
        tube, _along = points_on_arc(tip, self.rotation[n], self.curvature, self.insertion[n])
        outside = tube[self.airway_mm(tube) > -0.5]
        # Once the devices are out of the airway they only go away from it: no second lumen, no other branch.
        away = np.minimum(self.airway_mm(np.concatenate([outside, points])), self.tube_mm)
        if (np.diff(away) < -0.05).any():
            return 0.0
        return min(spare, float((self.others_mm(outside) - self.tube_mm).min(initial=np.inf)))

    def as_json(self, n, roll, curvature, length):
        """Return an answer as the benchmark wants it."""
        arc = {"length_mm": length, "roll_rad": roll, "curvature_per_mm": curvature}
        return {
            "scope": {"tip": int(self.tip[n])},
            "tubes": {
                "rotation_rad": float(self.rotation[n]),
                "outer_insertion_mm": 0.0,
                "inner_insertion_mm": float(self.insertion[n]),
                "lps_from_tip": self.starts[n].tolist(),
            },
            "needle": {"arcs": [arc]},
        }


def main(case, device_name, out):
    """Answer all queries of a case with one device."""
    case = Path(case)
    planner = Planner(case, json.loads((case.parent / "devices" / f"{device_name}.json").read_text()))
    answers = []
    for query in json.loads((case / "case.json").read_text())["queries"]:
        if query["device"] == device_name:
            began = time.process_time()
            found = planner.answer(np.array(query["target_lps"])) or {}
            answers.append({"query": query["name"], **found, "cpu_s": time.process_time() - began})
            print(query["name"], "planned" if found else "nothing found")
    head = {"schema": "lungaccess-submission/1", "benchmark": "synthetic-v1", "planner": "stranger"}
    Path(out).write_text(json.dumps({**head, "answers": answers}))


if __name__ == "__main__":
    main(*sys.argv[1:4])
