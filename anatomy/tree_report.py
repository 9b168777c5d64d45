"""What was changed or left out while an airway tree was made."""

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float


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
    """A twig that was taken off because it barely leaves the branch it grows from; its position is its tip.

    The length is that from the centreline of the parent to the tip.
    """


class LoopOpened(Repair):
    """A ring of the lumen (two airways that touch, a hole in a wall) that was cut where it is thinnest.

    Its position is that of the cut, and the length is that once around.
    """


@frozen_record
class TreeReport:
    """What was changed or left out while the tree was made.

    Args:
        gaps_bridged, spurs_pruned, loops_opened, pieces_left_out (tuple of records): Each with `position_lps`
            and `length_mm`; pieces of a few voxels are counted alone.
        components_dropped: Separate pieces of the mask that were left out.
        voxels_dropped: Voxels in these pieces.
        cavity_voxels: Voxels of holes enclosed in the lumen; the tree runs around them.
        warnings: What a user should look at before trusting the tree.
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
