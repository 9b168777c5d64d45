"""Where the tubes of many deployments leave the airway."""

import numpy as np

from anatomy.base.typed import Float, Int
from anatomy.poses import pose
from stages.tube.arcs import points_on_arcs
from stages.tube.deployments import Deployments
from stages.tube.design_shapes import shapes_of
from stages.tube.device import ConcentricTubes


def exit_points(tubes: ConcentricTubes, scope_tips: Float, deployments: Deployments, chosen: Int) -> Float:
    """Return the points `(N, 3)` LPS mm at which the axes of chosen deployments leave the lumen for good.

    Args:
        scope_tips ((S, 9) float64): Point, direction and +x of the frame of each scope tip, LPS mm;
            `deployments.site` counts them.
        chosen ((N,) int64): Which of the deployments.
    """
    tips, at_mm = scope_tips[deployments.site[chosen]], deployments.exit_mm[chosen]
    rotations = deployments.rotation_rad[chosen]
    shapes, points = shapes_of(tubes), np.zeros((len(chosen), 3))
    for row, (tip, shape) in enumerate(zip(tips, deployments.shape[chosen].tolist(), strict=True)):
        frame = pose(tip[:3], tip[3:6], tip[6:])
        points[row] = points_on_arcs(shapes.arcs_of(shape), frame, float(rotations[row]), at_mm[row])[0]
    return points
