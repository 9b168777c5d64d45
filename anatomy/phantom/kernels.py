"""Compiled drawing of tubes and balls into a voxel grid."""

import numpy as np

from anatomy.kernels.compiling import kernel

NODULE_OWNER = -1
"""Nodules belong to no branch."""


@kernel()
def paint_tree(
    labels, owner, lumen_cover, outer_cover, origin, spacing, points, inner, outer, branch_start,
    branch_parent, order, freedom, base, gap, slack, inner_code, outer_code, allowed, keep,
):  # fmt: skip
    """Draw the branches of a tree, each only if it fits; mark those drawn in `keep`.

    `labels` uint8, `owner` int16 (0 free, `base + branch + 1` of this tree, others taken) and the covers
    (uint8 share of a voxel, 0 to 255) are `(ni, nj, nk)`.  `points` `(N, 3)` LPS mm with the radii `inner`
    and `outer` `(N,)` form capsules between neighbours of a branch.  A branch is refused, with all that
    follows from it, if it reaches more than `slack` mm into a voxel of another tree, if its axis touches a
    voxel whose label is not `allowed[label]`, or if a distant branch of this tree lies within `gap` mm
    (negative: may touch).  Other voxels that are taken or not allowed are left as they are.  `freedom`
    `(B,)` lifts this: 1 allows all labels, 2 draws the branch in any case.
    """
    ni, nj, nk = labels.shape
    n_branches = branch_parent.shape[0]
    for o in range(n_branches):
        b = order[o]
        parent = branch_parent[b]
        if parent >= 0 and not keep[parent]:
            continue
        first = branch_start[b]
        near = 0.0
        if parent >= 0:
            near = outer[branch_start[parent + 1] - 1] + 2.0 * outer[first] + 2.0 * max(gap, 0.0) + spacing
        clash = False
        for phase in range(2):
            if phase == 1 and clash:
                break
            if phase == 0 and freedom[b] == 2:
                continue
            for p in range(first, branch_start[b + 1] - 1):
                if clash:
                    break
                ax, ay, az = points[p, 0], points[p, 1], points[p, 2]
                ux, uy, uz = points[p + 1, 0] - ax, points[p + 1, 1] - ay, points[p + 1, 2] - az
                uu = max(ux * ux + uy * uy + uz * uz, 1e-12)
                reach = max(outer[p], outer[p + 1]) + max(gap, spacing)
                i0 = max(0, int(np.floor((min(ax, ax + ux) - reach - origin[0]) / spacing)))
                i1 = min(ni - 1, int(np.ceil((max(ax, ax + ux) + reach - origin[0]) / spacing)))
                j0 = max(0, int(np.floor((min(ay, ay + uy) - reach - origin[1]) / spacing)))
                j1 = min(nj - 1, int(np.ceil((max(ay, ay + uy) + reach - origin[1]) / spacing)))
                k0 = max(0, int(np.floor((min(az, az + uz) - reach - origin[2]) / spacing)))
                k1 = min(nk - 1, int(np.ceil((max(az, az + uz) + reach - origin[2]) / spacing)))
                for k in range(k0, k1 + 1):
                    z = origin[2] + k * spacing - az
                    for j in range(j0, j1 + 1):
                        y = origin[1] + j * spacing - ay
                        for i in range(i0, i1 + 1):
                            x = origin[0] + i * spacing - ax
                            t = min(1.0, max(0.0, (x * ux + y * uy + z * uz) / uu))
                            dx, dy, dz = x - t * ux, y - t * uy, z - t * uz
                            d = np.sqrt(dx * dx + dy * dy + dz * dz)
                            r_out = outer[p] + t * (outer[p + 1] - outer[p])
                            if d > r_out + max(gap, spacing):
                                continue
                            who = owner[i, j, k]
                            same = who > base and who <= base + n_branches
                            free = freedom[b] > 0 or allowed[labels[i, j, k]]
                            if phase == 1:
                                if (who != 0 and not same) or not free:
                                    continue
                            else:
                                if not same:
                                    if (who != 0 and d <= r_out - slack) or (not free and d <= spacing):
                                        clash = True
                                elif d <= r_out + gap and gap >= 0.0:
                                    other = who - base - 1
                                    kin = other in (b, parent) or branch_parent[other] == parent
                                    if not kin:
                                        sx = ax + x - points[first, 0]
                                        sy = ay + y - points[first, 1]
                                        sz = az + z - points[first, 2]
                                        if sx * sx + sy * sy + sz * sz > near * near:
                                            clash = True
                                continue
                            r_in = inner[p] + t * (inner[p + 1] - inner[p])
                            share = min(1.0, max(0.0, (r_out - d) / spacing + 0.5))
                            outer_cover[i, j, k] = max(outer_cover[i, j, k], np.uint8(255.0 * share))
                            if inner_code != outer_code:
                                share = min(1.0, max(0.0, (r_in - d) / spacing + 0.5))
                                lumen_cover[i, j, k] = max(lumen_cover[i, j, k], np.uint8(255.0 * share))
                            if d <= r_in:
                                if labels[i, j, k] != inner_code or who == 0:
                                    owner[i, j, k] = base + b + 1
                                labels[i, j, k] = inner_code
                            elif d <= r_out and labels[i, j, k] != inner_code:
                                if labels[i, j, k] != outer_code:
                                    owner[i, j, k] = base + b + 1
                                labels[i, j, k] = outer_code
        keep[b] = not clash
