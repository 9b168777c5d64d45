"""What the page may ask: every message is read into one of these, and anything else is refused in words."""

import json
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Len
from pydantic import Field

from anatomy.base.errors import SettingsError
from anatomy.base.settings import parse, quantity, settings, text
from lungaccess.problem.goals import SUCCESS

MOST_CHARACTERS = 20_000
"""A message of the page is shorter by far."""
CLICKS, PLANS, REACH, ANSWERS = "clicks", "plans", "reach", "answers"
"""The processes that answer: what a click shows at once, the search for a plan, the reach of the system, and
what takes seconds.  The first never waits for a step of a search."""

Point = Annotated[tuple[float, float, float], Field(description="a point, LPS mm")]
Pixels = Annotated[int, Field(strict=True, ge=1, le=2048, description="pixels of a canvas")]
Number = Annotated[int, Field(strict=True, ge=0, le=2**53)]
FileKind = Literal[
    "plan.json", "summary.json", "report.html", "slicer.zip", "overview.png", "tree.png",
    "cost_over_time.csv", "cost_over_time.png", "system.toml",
]  # fmt: skip


@settings
class WhatIf:
    """A system, and what is changed of it; what is not stated is the system's own.

    Args:
        system: Name of a preset, or of the system that the explorer was started with.
        scope_diameter_mm, needle_radius_mm, needle_length_mm, margin_mm: Outer diameter of the bronchoscope,
            least radius of curvature and greatest length of the needle, and the margin for the border of the
            masks.
        fissures_allowed: Whether fissures may be crossed.
    """

    system: Annotated[str, text("name of a system")] = "lung-default"
    scope_diameter_mm: Annotated[float | None, quantity("outer diameter", above=0.0, at_most=20.0)] = None
    needle_radius_mm: Annotated[
        float | None, quantity("radius of curvature", at_least=5.0, at_most=10_000.0)
    ] = None
    needle_length_mm: Annotated[float | None, quantity("length of the needle", above=0.0, at_most=500.0)] = (
        None
    )
    margin_mm: Annotated[float | None, quantity("margin of the masks", at_least=0.0, at_most=20.0)] = None
    fissures_allowed: bool | None = None


@settings
class _Question:
    """What all questions have.

    Args:
        id: By which the answers are told apart.
        slot: A question takes the place of the one before with the same name and slot.
    """

    id: Number
    slot: Annotated[str, Len(0, 40)] = ""
    worker: ClassVar[str] = ANSWERS


@settings
class LookQuestion(_Question):
    """What lies in a folder of this machine; in the one where the explorer was started if none is named."""

    path: Annotated[str, Len(0, 4096)] = ""


@settings
class OpenQuestion(_Question):
    """Explore a patient, or segment a CT; of several series in a folder the answer lists all.

    Args:
        path: Folder or file of this machine.
        series: UID of the series.
        accept: Checks of `anatomy.plausibility.CHECKS` whose failure a person accepts.
        thick_slices: Whether slices of more than 3 mm are accepted.
    """

    path: Annotated[str, Len(1, 4096)]
    series: Annotated[str, Len(0, 200)] = ""
    accept: tuple[Annotated[str, Len(1, 40)], ...] = ()
    thick_slices: bool = False


@settings
class OutlineQuestion(_Question):
    """The nodule at a point: outlined at once, or made part of the patient, which is then explored anew."""

    point: Point
    take: bool = False


@settings
class PaintQuestion(_Question):
    """Correct the masks by hand: the answer is what the patient is from now on, at once for all questions.

    Args:
        tool: See `anatomy.strokes.Stroke`; `undo` takes the last stroke back; `open` only reads the masks,
            so that the first stroke need not wait for them.
        points: Along the stroke.
        radius_mm: Of the brush; of a fill how far it may reach.
        normal: Normal of the slice in which alone brush and fill act.
        level_hu: By how much a filled voxel may differ from the first point.
        what_if: The system whose atlas is made anew with the lung.
    """

    tool: Literal["open", "paint", "erase", "fill", "cut", "join", "undo"]
    structure: Literal["airway", "vessel", "fissure", "nodule"] = "vessel"
    points: Annotated[tuple[Point, ...], Len(0, 400)] = ()
    radius_mm: Annotated[float, quantity("radius of the brush", at_least=0.2, at_most=30.0)] = 2.0
    normal: Point | None = None
    level_hu: Annotated[float, quantity("difference in HU", at_least=1.0, at_most=2000.0)] = 150.0
    what_if: WhatIf = WhatIf()


@settings
class PatientQuestion(_Question):
    """The patient, the systems and their limits."""

    worker: ClassVar[str] = CLICKS


@settings
class SceneQuestion(_Question):
    """Surfaces of all structures and the voxels of the whole lung."""


@settings
class ImageQuestion(_Question):
    """Fine voxels around a point."""

    around: Point


@settings
class SliceQuestion(_Question):
    """The CT at the pixels of a plane, as `lungaccess.showing.explorer.patient.ct_slice` takes it."""

    origin: Point
    across: Point
    down: Point
    columns: Pixels
    rows: Pixels


@settings
class PlaceQuestion(_Question):
    """What is at a point."""

    point: Point
    worker: ClassVar[str] = CLICKS


@settings
class PrepareQuestion(_Question):
    """All that scope and tubes can do: the atlas, and the tips of the scope."""

    what_if: WhatIf = WhatIf()
    worker: ClassVar[str] = CLICKS


@settings
class ReadyQuestion(_Question):
    """The atlas of a system in the process that plans, so that the first plan does not wait for it."""

    what_if: WhatIf = WhatIf()
    worker: ClassVar[str] = PLANS


@settings
class ExitsQuestion(_Question):
    """The feasible exits of a target, `ras:x,y,z`, `lps:x,y,z`, `nodule N` or a name."""

    target: Annotated[str, Len(1, 200)]
    what_if: WhatIf = WhatIf()
    scope_tip: Number | None = None
    worker: ClassVar[str] = CLICKS


@settings
class PlanQuestion(_Question):
    """Better and better plans to a target; from one deployment or place of the scope where that is given."""

    target: Annotated[str, Len(1, 200)]
    what_if: WhatIf = WhatIf()
    goal: Annotated[str, Len(1, 200)] = SUCCESS.name
    iterations: Annotated[int, Field(strict=True, ge=0, le=20_000)] = 20
    seed: Number = 0
    scope_tip: Number | None = None
    entry: Number | None = None
    worker: ClassVar[str] = PLANS


@settings
class ReachQuestion(_Question):
    """What of the lung the system reaches, what is around a point first."""

    around: Point
    what_if: WhatIf = WhatIf()
    worker: ClassVar[str] = REACH


@settings
class AppraiseQuestion(_Question):
    """Check, chance of success, limits and window of a plan, by its digest."""

    plan: Annotated[str, Len(1, 128)]


@settings
class ExplainQuestion(_Question):
    """Why there is no plan, and what would help."""

    target: Annotated[str, Len(1, 200)]
    what_if: WhatIf = WhatIf()
    objective: Annotated[str, Len(1, 200)] = "default"
    seed: Number = 0


@settings
class ExportQuestion(_Question):
    """A file about a plan, by its digest."""

    plan: Annotated[str, Len(1, 128)]
    what: FileKind


QUESTIONS: Mapping[str, type[_Question]] = {
    each.__name__.removesuffix("Question").lower(): each for each in _Question.__subclasses__()
}
"""The questions by their name, as "look" for `LookQuestion`, which the key "ask" of a message states."""
CANCEL = "cancel"
"""The message that ends what is being done for the question with the same number."""
Question = Any
"""An instance of one of `QUESTIONS`."""


def read_message(text_of_message: str) -> tuple[str, Question]:
    """Return the name of a question and the question, or CANCEL and the number of the question to end.

    Raises SettingsError if the message is too long, no JSON object, of an unknown kind, or a value in it is
    wrong.
    """
    if len(text_of_message) > MOST_CHARACTERS:
        raise SettingsError("The message is too long", expected=f"at most {MOST_CHARACTERS} characters")
    try:
        values = json.loads(text_of_message, parse_constant=_refused)
    except (ValueError, RecursionError) as error:
        raise SettingsError("The message is no JSON", expected="a JSON object") from error
    if not isinstance(values, dict):
        raise SettingsError("The message is no JSON object", expected='an object with "ask" and "id"')
    ask = values.pop("ask", None)
    if ask == CANCEL:
        return CANCEL, parse(_Question, values, "The message").id
    if not isinstance(ask, str) or ask not in QUESTIONS:
        raise SettingsError(
            "The message asks nothing that is known", expected=f'"ask": one of {", ".join(QUESTIONS)}'
        )
    return ask, parse(QUESTIONS[ask], values, f"The question {ask!r}")


def number_of(text_of_message: str) -> int | None:
    """Return the number that a message states, as far as it can be read: its error is an answer to it."""
    try:
        number = json.loads(text_of_message)["id"]
    except (ValueError, RecursionError, TypeError, KeyError):
        return None
    return number if isinstance(number, int) and not isinstance(number, bool) else None


def _refused(constant: str) -> None:
    raise ValueError(constant)
