"""The plan behind a reachable voxel of a map, made again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from anatomy.base.errors import SettingsError, TargetError
from anatomy.base.typed import Int
from lungaccess.planning.coupled import direct_candidates, reach_scan
from lungaccess.planning.coupled.atlas import Atlas, require_same
from lungaccess.planning.coupled.search.direct_arcs import DirectArcs
from lungaccess.planning.reachability.layers import voxel_seeds
from lungaccess.planning.reachability.reach_map import ReachMap
from lungaccess.plans.assemble import assemble
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.insertion import with_simplest_motion
from lungaccess.plans.plan import Plan
from lungaccess.problem.target import point_target
from lungaccess.problem.task import Task
from stages.needle import SEARCHED, ReachScan


def plan_to_voxel(reach: ReachMap, atlas: Atlas, ijk: Int) -> Plan:
    """Return the plan to the centre of a reachable voxel, as it was found for the map.

    Parameters
    ----------
    reach : ReachMap
        Of the masks alone, without phases.
    atlas : Atlas
        The one of the map, or made again with the same settings.
    ijk : (3,) int64
        Indices of the voxel.

    Raises
    ------
    TargetError
        If the voxel is not reachable.
    SettingsError
        If the map is one for phases, or the atlas is not that of the map.
    """
    if reach.phases is not None:
        raise SettingsError(
            "The map is one for phases of the breath",
            expected="one of the masks alone",
            remedy="Plan to the voxel with lungaccess.plan and its phases",
        )
    require_same(atlas, atlas.lung, reach.system)
    grid, voxel = reach.kinds.grid, (int(ijk[0]), int(ijk[1]), int(ijk[2]))
    entry = int(reach.deployment.array[voxel])
    if entry < 0:
        raise TargetError(
            f"Voxel {list(voxel)} of the map is not reachable",
            expected="one of its kinds direct arc or search",
        )
    place = grid.lps(voxel)
    task = Task(lung=atlas.lung, system=reach.system, target=point_target(atlas.lung, place))
    found = direct_candidates(task, atlas)
    candidate = found.proved(entry)
    if reach.kinds.array[voxel] == SEARCHED and isinstance(found, DirectArcs):
        seed = int(voxel_seeds(grid, np.array([voxel]))[0])
        candidate = _searched(found, entry, reach.trees, seed)
    if candidate is None:
        raise SettingsError(
            f"Deployment {entry} of the atlas does not lead to voxel {list(voxel)}",
            expected="the atlas with which the map was made",
        )
    return with_simplest_motion(assemble(task, candidate, iteration=0, timing={}), atlas.lung)


def _searched(arcs: DirectArcs, entry: int, trees: int, seed: int) -> Candidate | None:
    """Return a deployment with the path of several arcs that the map's search found; None if it fails."""
    made, scan = arcs.candidate(entry), reach_scan(arcs.atlas, trees=trees)
    if made is None or not isinstance(scan, ReachScan):
        return None
    path = scan.searched_path(arcs.task.target.lps_mm, seed, made.deployment.lps_from_tip)
    if path is None or not arcs.evaluator.proves(made.deployment, path):
        return None
    return replace(made, path=path)
