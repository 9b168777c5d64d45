"""Growth of the airway from what is known of it, level by level; leaks are undone piece by piece.

Volumes are `(nk, nj, ni)`, C-contiguous, and voxels are named by their flat index, int64.  Around the image
lies a border, of two voxels or more, of depth 0: nothing grows there, and only neighbours of voxels that grew
or might are looked at.  `state` is uint8: FREE, LUMEN, BANNED, or the mark of a level.
"""

import numpy as np

from anatomy.kernels.compiling import kernel, merged_kernel
from anatomy.segmentation.kernels.neighbours import box_offsets
from anatomy.segmentation.kernels.states import BANNED, FREE, LUMEN

IN_LAYER = np.uint8(3)
IN_SECTION = np.uint8(4)
FIRST_MARK = 5
"""Marks of level `n`: `FIRST_MARK + 2 n` for what may become lumen, one more for what may not.

There is room for 125 levels in uint8.
"""
DARK_SHARE = 0.1
"""Where more than this of what lies behind a cross-section is dark, it is a narrow of an airway."""
MOST_RINGS = 5
"""A piece with more rings is lung between vessels: bronchi have none, and their noise makes a few."""
REPEATS = 8
"""How often a piece is grown anew around the leaks that were cut out of it."""


@kernel()
def touches_lumen(state, near, at):
    """Tell whether a neighbour is lumen."""
    for d in near:
        if state[at + d] == LUMEN:
            return True
    return False


@kernel()
def flood(depth, state, near, start, level, mark, front_factor, front_slack, queue, parent, layer_ends):
    """Grow one piece at a level from a voxel beside the lumen.

    Returns its size, the number of its layers and whether it burst.  The size is at most `len(parent)`, and
    there are no more layers than voxels: room in `queue`, `parent` and `layer_ends` for as many is enough.

    Behind its first layer a piece keeps one voxel away from the lumen, so that the skin of the airway
    does not join all its branches.  It bursts if it meets one that did, if its front grows beyond
    `front_factor` times the widest of its first layers and `front_slack` voxels more, or if it outgrows
    the lists.
    """
    queue[0] = start
    parent[0] = 0
    state[start] = mark
    head = 0
    tail = 1
    layer = 1
    layer_end = 1
    widest = 0
    while head < tail:
        at = queue[head]
        for d in near:
            to = at + d
            here = state[to]
            if here == mark + 1:
                return tail, layer, True
            if here == mark or here == LUMEN or here == BANNED or depth[to] < level:
                continue
            if touches_lumen(state, near, to):
                continue
            if tail == len(parent):
                return tail, layer, True
            state[to] = mark
            queue[tail] = to
            parent[tail] = head
            tail += 1
        head += 1
        if head == layer_end and tail > layer_end:
            front = tail - layer_end
            layer_ends[layer - 1] = layer_end
            layer += 1
            layer_end = tail
            # The front of a piece is compared with the widest of its first layers.
            if layer <= 3:
                widest = max(widest, front)
            elif front > front_factor * widest + front_slack:
                return tail, layer, True
    layer_ends[layer - 1] = tail
    return tail, layer, False


@kernel()
def rings_of(state, shape, mark, queue, size):
    """Return how many rings a piece has, less the hollows in it: one less its Euler characteristic.

    Its voxels, listed in `queue`, are those of `mark`.  Each corner, edge and face of them is counted by the
    first voxel that has it.
    """
    steps = np.array((shape[1] * shape[2], shape[2], 1))
    characteristic = 0
    for q in range(size):
        at = queue[q]
        for dk in range(-1, 2):
            for dj in range(-1, 2):
                for di in range(-1, 2):
                    first = True
                    for k in range(min(dk, 0), max(dk, 0) + 1):
                        for j in range(min(dj, 0), max(dj, 0) + 1):
                            for i in range(min(di, 0), max(di, 0) + 1):
                                d = k * steps[0] + j * steps[1] + i * steps[2]
                                if d < 0 and state[at + d] == mark:
                                    first = False
                    if first:
                        odd = (abs(dk) + abs(dj) + abs(di)) % 2
                        characteristic += 1 if odd == 1 else -1
    return 1 - characteristic


@merged_kernel
def ban_pockets(hu, state, near, size, mark, wide, rim, dark_hu, queue, parent, behind, layer_ends, layers):
    """Ban the cross-sections of a piece that are wide and not dark, and what lies behind them.

    The piece lies in `queue` layer by layer; a cross-section is what hangs together of a layer.  One of
    `wide` voxels or more is lung between vessels, not an airway, if its darkest voxel is above `dark_hu`
    and little that is darker lies behind it; so are the voxels of the piece within `rim` steps of a banned
    one.  Sections and rims are listed in `queue` behind the piece, each voxel once: it holds `2 size`.
    A piece of which that is a large share is banned altogether.  Returns the number of voxels banned.
    """
    for q in range(size):
        behind[0, q] = 1
        behind[1, q] = 1 if hu[queue[q]] < dark_hu else 0
    for q in range(size - 1, 0, -1):
        behind[0, parent[q]] += behind[0, q]
        behind[1, parent[q]] += behind[1, q]
    found = False
    first = 0
    for layer in range(layers):
        end = layer_ends[layer]
        if end - first >= wide:
            for q in range(first, end):
                state[queue[q]] = IN_LAYER
            for q in range(first, end):
                if state[queue[q]] != IN_LAYER:
                    continue
                head = size
                tail = size + 1
                queue[head] = queue[q]
                state[queue[q]] = mark
                while head < tail:
                    at = queue[head]
                    head += 1
                    for d in near:
                        if state[at + d] == IN_LAYER:
                            state[at + d] = mark
                            queue[tail] = at + d
                            tail += 1
                if tail - size < wide:
                    continue
                darkest = hu[queue[size]]
                for n in range(size, tail):
                    darkest = min(darkest, hu[queue[n]])
                    state[queue[n]] = IN_SECTION
                all_behind = 0
                dark_behind = 0
                for n in range(first, end):
                    if state[queue[n]] == IN_SECTION:
                        all_behind += behind[0, n]
                        dark_behind += behind[1, n]
                bright = darkest > dark_hu and dark_behind <= DARK_SHARE * all_behind
                for n in range(size, tail):
                    state[queue[n]] = BANNED if bright else mark
                found = found or bright
        first = end
    if not found:
        return 0
    for _ in range(rim):
        tail = size
        for q in range(size):
            if state[queue[q]] == mark:
                for d in near:
                    if state[queue[q] + d] == BANNED:
                        queue[tail] = queue[q]
                        tail += 1
                        break
        for n in range(size, tail):
            state[queue[n]] = BANNED
    banned = 0
    for q in range(size):
        if state[queue[parent[q]]] == BANNED:
            state[queue[q]] = BANNED
            banned += 1
    # A piece of which more than this lies in or behind pockets is one.
    if banned > 0.2 * size:
        for q in range(size):
            state[queue[q]] = BANNED
        return size
    return banned


@kernel()
def grow_airway(
    depth, hu, state, shape, lumen, count, levels, least_layers, front_factor, front_slack, wide, rim,
    dark_hu, skin_share, queue, parent, behind, layer_ends,
):  # fmt: skip
    """Add to the lumen, level by level, the pieces of a local minima map that branch off it.

    Args:
        depth, hu, state (flat int16, int16, uint8): `state` holds LUMEN where growth starts, and is changed.
        shape ((3,) int64): nk, nj, ni, with the border.
        lumen ((R,) int64): Its first `count` entries list the lumen; the others are filled in.  Growth ends
            where it is full.
        levels ((L,) int64): Falling and positive, at most 125; a voxel can join at a level if it is at least
            this deep.
        least_layers (int): Pieces of fewer layers are roughness of the wall.
        front_factor, front_slack (float): A piece bursts whose front is larger than the widest of its first
            layers by this factor and by so many voxels more.
        wide (float): Cross-sections of so many voxels or more are dark inside if they are an airway's.
        rim (int): What lies within so many steps of one that is not dark is banned with it.
        dark_hu (float): Below it is air, above it the tissue of the lung.
        skin_share (float): Beside a voxel that joins, others join down to this share of its depth.
        queue, parent, behind, layer_ends ((2 R,), (R,), (2, R), (R,) int64): Room to work in; a piece has at
            most R voxels.

    Returns:
        - count (int)
        - undone (int) - Voxels that were grown and undone.
    """
    near = box_offsets(shape, 1)
    undone = 0
    for n in range(len(levels)):
        level = levels[n]
        mark = np.uint8(FIRST_MARK + 2 * n)
        burst_here = 0
        known = count
        for s in range(known):
            for d in near:
                start = lumen[s] + d
                for _ in range(REPEATS):
                    here = state[start]
                    if depth[start] < level or here == LUMEN or here == BANNED:
                        break
                    if here == mark or here == mark + 1:
                        break
                    size, layers, burst = flood(
                        depth, state, near, start, level, mark, front_factor, front_slack, queue, parent,
                        layer_ends,
                    )  # fmt: skip
                    burst = burst or count + size > len(lumen)
                    if burst or rings_of(state, shape, mark, queue, size) > MOST_RINGS:
                        for q in range(size):
                            state[queue[q]] = mark + 1
                        burst_here += size
                        break
                    if layers < least_layers:
                        break
                    banned = ban_pockets(
                        hu, state, near, size, mark, wide, rim, dark_hu, queue, parent, behind, layer_ends,
                        layers,
                    )  # fmt: skip
                    if banned > 0:
                        undone += banned
                        for q in range(size):
                            if state[queue[q]] == mark:
                                state[queue[q]] = FREE
                        continue
                    count = join(depth, state, near, size, levels[-1], skin_share, queue, lumen, count)
                    break
        if n == len(levels) - 1:
            undone += burst_here
    return count, undone


@kernel()
def join(depth, state, near, size, floor, skin_share, queue, lumen, count):
    """Make a piece lumen, with the voxels beside it that are nearly as deep; return the new count."""
    for q in range(size):
        state[queue[q]] = LUMEN
        lumen[count] = queue[q]
        count += 1
    for q in range(size):
        least = max(skin_share * depth[queue[q]], 0.5 * floor)
        for d in near:
            to = queue[q] + d
            free = state[to] != LUMEN and state[to] != BANNED
            if free and depth[to] >= least and count < len(lumen):
                state[to] = LUMEN
                lumen[count] = to
                count += 1
    return count
