"""What a procedure measures after each stage, to what error, and whether it plans again from there."""

import os
from typing import Annotated

from anatomy.base.settings import parse, quantity, settings, switch, text
from lungaccess.problem.preset_files import PresetFiles

DEFAULT_PROCEDURE = "open-loop"
_FILES = PresetFiles(
    what="procedure",
    folders=("presets/procedures",),
    remedy="`lungaccess template procedure` prints a complete file to start from",
    expected="tables such as [scope] with lines such as measured = true",
)

_Measured = Annotated[bool, switch("whether the tip is measured, and the rest planned again from there")]
_Position = Annotated[
    float, quantity("standard deviation of the measured tip, along each axis", at_least=0.0, at_most=20.0)
]
_Direction = Annotated[
    float, quantity("standard deviation of its direction, about each of two axes", at_least=0.0, at_most=45.0)
]
_Source = Annotated[str, text("where the errors of measuring come from, or 'assumption'")]


@settings
class ScopePlacing:
    """What is done once the bronchoscope stands where the plan has it.

    Args:
        position_mm, direction_deg: Errors of measuring: of the position along each axis, of the direction
            about each of two axes.
        placements: How often the scope may be placed.  It is moved away and placed again, at the same tip,
            where no path is left from the pose as measured, or a further placement promises more; each has
            errors of its own.
    """

    measured: _Measured = False
    position_mm: _Position = 0.0
    direction_deg: _Direction = 0.0
    placements: Annotated[
        int, quantity("how often the bronchoscope may be placed", at_least=1, at_most=20)
    ] = 1
    source: _Source = "assumption"


@settings
class TubesOut:
    """What is done once the tubes are out: the needle is planned again from their tip as measured."""

    measured: _Measured = False
    position_mm: _Position = 0.0
    direction_deg: _Direction = 0.0
    source: _Source = "assumption"


@settings
class Imaging:
    """An image before the needle starts, in which the target is found again."""

    measured: Annotated[bool, switch("whether the target is found again before the needle starts")] = False
    position_mm: Annotated[
        float, quantity("standard deviation of the target as found, along each axis", at_least=0, at_most=20)
    ] = 0.0
    source: _Source = "assumption"


@settings
class NeedleSteering:
    """Whether the needle is measured and planned again while it is inserted, and by what tracker.

    Args:
        measure_every_mm: Insertion between two measurements: the speed over the tracker's rate.
        replan_every_mm: Least insertion between two replans; measurements between them only correct what is
            believed.
        position_mm, direction_deg: Errors of measuring, as of `ScopePlacing`.
        target_mm: Error of the target as tracked, along each axis; None where it is not seen during the
            insertion.
        latency_mm: Insertion between a measurement and its use: the speed times the tracker's delay.
    """

    closed_loop: Annotated[bool, switch("whether the needle is measured and planned again on its way")] = (
        False
    )
    measure_every_mm: Annotated[
        float, quantity("insertion between two measurements", above=0.0, at_most=500.0)
    ] = 5.0
    replan_every_mm: Annotated[
        float, quantity("least insertion between two replans", at_least=0.0, at_most=500.0)
    ] = 0.0
    position_mm: _Position = 0.0
    direction_deg: _Direction = 0.0
    target_mm: Annotated[float, quantity("error of the tracked target", at_least=0, at_most=20)] | None = None
    latency_mm: Annotated[
        float, quantity("insertion between a measurement and its use", at_least=0.0, at_most=100.0)
    ] = 0.0
    lost_share: Annotated[
        float, quantity("share of the measurements that are lost", at_least=0.0, at_most=1.0)
    ] = 0.0
    source: _Source = "assumption"


@settings
class Procedure:
    """What is measured and corrected after each stage; without arguments nothing is.

    Args:
        least_margin_share: Share of the margins that a path from a measured pose has to keep where none keeps
            them whole; margins allow for errors that are known by then.
    """

    name: Annotated[str, text("what the procedure is called where its results are shown")] = "stated"
    description: Annotated[str, text("one sentence for people", may_be_empty=True)] = ""
    least_margin_share: Annotated[
        float,
        quantity("share of the margins that is kept where no path keeps them whole", at_least=0, at_most=1),
    ] = 1.0
    scope: ScopePlacing = ScopePlacing()
    tubes: TubesOut = TubesOut()
    imaging: Imaging = Imaging()
    needle: NeedleSteering = NeedleSteering()

    @property
    def is_open_loop(self) -> bool:
        """Whether nothing is measured, so that the plan is carried out as it stands."""
        return not (self.scope.measured or self.tubes.measured or self.needle.closed_loop)


procedure_names = _FILES.names
"""Returns the names of the procedures that ship with the package, sorted."""


def load_procedure(name_or_path: str | os.PathLike[str] = DEFAULT_PROCEDURE) -> Procedure:
    """Read a procedure from a preset or from a TOML file; tables that are left out measure nothing.

    What may be stated, and the errors, are those of `lungaccess.problem.system.load_system`.
    """
    given = os.fspath(name_or_path)
    stated = _FILES.read(name_or_path)
    if given in _FILES.names():
        return parse(Procedure, stated, given)
    return parse(Procedure, {"name": os.path.basename(given), **stated}, given, remedy=_FILES.remedy)
