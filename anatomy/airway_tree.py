"""The airway tree: a rooted tree of centred points with radius, branches and generations, and its repairs."""

from dataclasses import field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import AnatomyError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Int
from anatomy.grid import freeze_arrays, read_only

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

    from anatomy.tree.naming import BronchialNames


@frozen_record
class Repair:
    """A place, LPS mm, where the tree differs from the mask; its kind says what the length measures."""

    position_lps: Float
    length_mm: float


@frozen_record
class GapBridged(Repair):
    """A break of the lumen across which the tree was continued; its position is the middle of the gap.

    The length is the distance between the two facing voxels, as solid boxes; 0 where they touch by an
    edge or corner alone.  `voxels_joined` is the size of the piece that was joined, 0 where the pieces
    touch.
    """

    voxels_joined: int


@frozen_record
class PieceLeftOut(Repair):
    """A piece of the mask that hangs on nothing; its position is the middle of the gap to the rest.

    The length is that of the gap, `middle_lps` the middle of the piece, and `voxels` how many it has.
    """

    middle_lps: Float
    voxels: int


class SpurPruned(Repair):
    """A twig taken off as it barely leaves its branch, at its tip; long from the parent's line to it."""


class LoopOpened(Repair):
    """A ring of the lumen (touching airways, a hole in a wall) cut where thinnest; long once around."""


@frozen_record
class TreeReport:
    """What was changed or left out while the tree was made.

    Pieces of a few voxels that are left out are counted alone, with their voxels.  `cavity_voxels` are those
    of holes enclosed in the lumen, around which the tree runs; the warnings say what to look at before
    trusting the tree.
    """

    gaps_bridged: tuple[GapBridged, ...] = ()
    spurs_pruned: tuple[SpurPruned, ...] = ()
    loops_opened: tuple[LoopOpened, ...] = ()
    pieces_left_out: tuple[PieceLeftOut, ...] = ()
    components_dropped: int = 0
    voxels_dropped: int = 0
    cavity_voxels: int = 0
    warnings: tuple[str, ...] = ()

    def repairs(self) -> tuple[tuple[str, int], ...]:
        """Return what was done to the mask, and how often."""
        return (
            ("gaps bridged", len(self.gaps_bridged)),
            ("loops opened", len(self.loops_opened)),
            ("spurs pruned", len(self.spurs_pruned)),
            ("pieces left out", self.components_dropped),
        )


@frozen_record
class AirwayTree:
    """Centreline tree of the airway; N points, B branches, parents before children.

    The points of a branch are consecutive.  The first point of a branch hangs on `parent_point`, a
    point of its parent branch (its last one, or an earlier one where three or more branches part).  Raises
    AnatomyError if the arrays do not describe one tree.

    Args:
        points_lps ((N, 3) float64): LPS mm.
        radius_mm ((N,) float64): Distance from the point to the border of the lumen; 0 in a bridged gap.
        parent_point ((N,) int64): The next point towards the root; -1 at the root.
        branch_of_point: (N,) int64.
        branch_start ((B + 1,) int64): The points of branch b are `branch_start[b]:branch_start[b + 1]`.
        branch_parent ((B,) int64): -1 for the trachea, which is branch 0.
        generation ((B,) int64): 0 for the trachea, one more at each branching.
        distance_from_root_mm ((N,) float64): Length along the tree.
        tangents ((N, 3) float64): Unit vectors in LPS that point away from the root.
    """

    points_lps: Float
    radius_mm: Float
    parent_point: Int
    branch_of_point: Int
    branch_start: Int
    branch_parent: Int
    generation: Int
    distance_from_root_mm: Float
    tangents: Float
    report: TreeReport = field(default_factory=TreeReport)

    def __post_init__(self) -> None:
        freeze_arrays(self, "points_lps", "radius_mm", "distance_from_root_mm", "tangents", dtype=np.float64)
        indices = ("parent_point", "branch_of_point", "branch_start", "branch_parent", "generation")
        freeze_arrays(self, *indices, dtype=np.int64)
        problem = self._problem()
        if problem:
            raise AnatomyError(
                f"The arrays of an airway tree contradict each other: {problem}",
                expected="one rooted tree, parents before children",
                remedy="Make the tree with tree_from_mask or tree_from_graph",
            )

    def _problem(self) -> str:
        n, b = len(self.points_lps), len(self.branch_parent)
        shapes = {
            "points_lps": (n, 3), "radius_mm": (n,), "parent_point": (n,), "branch_of_point": (n,),
            "branch_start": (b + 1,), "generation": (b,), "distance_from_root_mm": (n,), "tangents": (n, 3),
        }  # fmt: skip
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                return f"{name} has the shape {getattr(self, name).shape}, not {shape}"
        if n == 0 or b == 0:
            return "it has no points"
        measured = (self.points_lps, self.radius_mm, self.tangents)
        if not all(np.isfinite(each).all() for each in measured):
            return "a point, radius or tangent is not finite"
        if self.branch_start[0] != 0 or self.branch_start[-1] != n or (np.diff(self.branch_start) < 1).any():
            return "branch_start does not divide the points"
        if not np.array_equal(self.branch_of_point, np.repeat(np.arange(b), np.diff(self.branch_start))):
            return "branch_of_point disagrees with branch_start"
        index, first = np.arange(n), np.zeros(n, dtype=bool)
        first[self.branch_start[:-1]] = True
        if self.parent_point[0] != -1 or (self.parent_point[1:] < 0).any():
            return "it has not exactly one root"
        if (self.parent_point >= index).any() or (self.parent_point[~first] != index[~first] - 1).any():
            return "a point comes before its parent"
        hangs_on = self.branch_of_point[self.parent_point[self.branch_start[1:-1]]]
        if self.branch_parent[0] != -1 or not np.array_equal(hangs_on, self.branch_parent[1:]):
            return "branch_parent disagrees with parent_point"
        expected = self.generation[self.branch_parent[1:]] + 1
        if self.generation[0] != 0 or not np.array_equal(self.generation[1:], expected):
            return "generation disagrees with branch_parent"
        return ""

    def _repr_html_(self) -> str:
        """Return the tree as HTML: its figures, and a drawing from the front."""
        from anatomy.display import side_by_side, table

        return side_by_side(table(self.figures(), "Airway tree"), self.drawing())

    def drawing(self) -> str:
        """Return an SVG of the tree from the front: branches coloured by generation, true to their width."""
        from anatomy.display import CORONAL, GENERATION_COLOURS, Drawing

        drawing = Drawing(CORONAL)
        for branch in range(self.n_branches):
            nodes = self.branch_points(branch)
            hangs_on = int(self.parent_point[nodes[0]])
            points = self.points_lps[nodes if hangs_on < 0 else np.append(hangs_on, nodes)]
            colour = GENERATION_COLOURS[min(int(self.generation[branch]), len(GENERATION_COLOURS) - 1)]
            drawing.line(points, colour, max(2.0 * float(self.branch_mean_radius_mm[branch]), 0.6))
        return drawing.svg()

    def figures(self) -> list[tuple[str, str]]:
        """Return names and values of what is worth knowing of the tree: size, carina, repairs."""
        from anatomy.display import point

        return [
            ("branches", f"{self.n_branches}, to generation {int(self.generation.max())}"),
            ("length", f"{float(self.branch_length_mm.sum()):.0f} mm"),
            ("carina, LPS mm", point(self.carina_lps)),
            *((name, str(count)) for name, count in self.report.repairs() if count),
        ]

    @property
    def n_points(self) -> int:
        """Number of points, N."""
        return len(self.points_lps)

    @property
    def n_branches(self) -> int:
        """Number of branches, B."""
        return len(self.branch_parent)

    @cached_property
    def branch_length_mm(self) -> Float:
        """Length of each branch from the point it hangs on to its last point, `(B,)` mm."""
        begin = np.maximum(self.parent_point[self.branch_start[:-1]], 0)
        end = self.branch_start[1:] - 1
        return read_only(self.distance_from_root_mm[end] - self.distance_from_root_mm[begin])

    @cached_property
    def branch_mean_radius_mm(self) -> Float:
        """Mean radius of the points of each branch, `(B,)` mm."""
        return read_only(np.add.reduceat(self.radius_mm, self.branch_start[:-1]) / np.diff(self.branch_start))

    @property
    def carina_point(self) -> int:
        """Index of the last point of the trachea, where it divides."""
        return int(self.branch_start[1]) - 1

    @property
    def carina_lps(self) -> Float:
        """Position of the carina (the last point of branch 0), `(3,)` LPS mm."""
        carina: Float = self.points_lps[self.carina_point]
        return carina

    @cached_property
    def mediastinal(self) -> Bool:
        """Which branches `(B,)` lie in the mediastinum: the trachea and the main bronchi.

        Whoever leaves the airway there pierces the mediastinal pleura, whatever masks hold beside it.  The
        children of the trachea are main bronchi.  Where a narrow side branch parts (a bronchus of the trachea
        itself, a twig that is an error of the mask), the trachea or main bronchus goes on in the wide one.
        In a tree of one branch nothing says what it is, and none is marked.
        """
        rank = np.zeros(self.n_branches, dtype=np.int64)
        for branch in range(1, self.n_branches):
            parent = int(self.branch_parent[branch])
            radius = self.branch_mean_radius_mm / self.branch_mean_radius_mm[parent]
            others = radius[np.setdiff1d(self.children(parent), branch)]
            # Main bronchi have 0.6 to 0.85 of the trachea's radius where it forks, lobar bronchi less of
            # theirs: this branch goes on as its parent, which only gave off narrow ones.
            continues = radius[branch] >= 0.85 and (others < 0.6).all()
            rank[branch] = rank[parent] + (not continues)
        mediastinal: Bool = (rank <= 1) & (self.n_branches > 1)
        return read_only(mediastinal)

    @cached_property
    def bronchi(self) -> "BronchialNames":
        """Which bronchus each branch is, with a confidence; see `anatomy.tree.naming`."""
        from anatomy.tree.naming import name_bronchi

        return name_bronchi(self)

    @cached_property
    def nearest_point_index(self) -> "cKDTree":
        """Search tree of the points: `query` finds the nearest tree points of any points."""
        from scipy.spatial import cKDTree

        return cKDTree(self.points_lps)

    @cached_property
    def leaf_branches(self) -> Int:
        """Branches without children."""
        return read_only(np.setdiff1d(np.arange(self.n_branches), self.branch_parent[1:]))

    def branch_points(self, branch: int) -> Int:
        """Return the indices of the points of a branch, from proximal to distal."""
        self._require(branch, self.n_branches, "branch")
        return np.arange(self.branch_start[branch], self.branch_start[branch + 1])

    def children(self, branch: int) -> Int:
        """Return the branches that hang on `branch`."""
        self._require(branch, self.n_branches, "branch")
        return np.flatnonzero(self.branch_parent == branch)

    def route(self, point: int) -> Int:
        """Return the indices of the points from the root to `point`, both included."""
        self._require(point, self.n_points, "point")
        indices = [int(point)]
        while self.parent_point[indices[-1]] >= 0:
            indices.append(int(self.parent_point[indices[-1]]))
        return np.array(indices[::-1], dtype=np.int64)

    def nearest_point(self, lps: ArrayLike) -> int:
        """Return the index of the tree point nearest to a position `(3,)` in LPS mm."""
        offset = self.points_lps - np.asarray(lps, dtype=np.float64)
        return int(np.argmin(np.einsum("ij,ij->i", offset, offset)))

    @staticmethod
    def _require(index: int, count: int, name: str) -> None:
        if not 0 <= index < count:
            raise AnatomyError(
                f"The tree has no {name} {index}",
                expected=f"an index from 0 to {count - 1}",
                remedy="Take it from this tree",
            )
