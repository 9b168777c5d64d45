"""The tubes alone: what one deployment does and what would sweep less, and all that a design can do."""

import math
import os
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from anatomy.base.errors import SettingsError
from anatomy.base.files import atomic_write, read_toml
from anatomy.base.records import frozen_value
from anatomy.base.settings import impossible, parse, settings, text, to_mapping
from lungaccess.problem.system import System, load_system
from stages import tube as stage

_REMEDY = "`lungaccess template tubes` prints a complete file to start from"
MOST_TURN_RAD = 2.0 * math.pi
"""Tubes that are turned farther come back to where they were, and the steps on the way have no end."""


@settings
class BareTubes:
    """One to three tubes without the rest of a system, all of which may be curved.

    SettingsError is raised if there are none or more, or they do not nest.
    """

    name: Annotated[str, text("name of the tubes")]
    tubes: Annotated[tuple[stage.Tube, ...], Field(description="the tubes, the innermost first")]

    def __post_init__(self) -> None:
        if not 1 <= len(self.tubes) <= 3:
            raise impossible("tubes", len(self.tubes), "one to three tables [[tubes]], the innermost first")
        try:
            stage.check_nesting(self.tubes)
        except SettingsError as error:
            raise impossible("tubes", error.found, error.expected) from None


@frozen_value
class TubeAnswer:
    """A deployment as in [Kuntz2015], and what it does; bare tubes have no system.

    `final` are the deployed tubes: if they snap before, an equilibrium that this sequence does not reach.
    Then there are no steps in `deployed`.
    """

    name: str
    system: System | None
    outer_mm: float
    inner_mm: float
    rotation_rad: float
    relative_rad: float
    final: stage.Equilibrium
    deployed: stage.DeployedSequence | None
    snap: stage.SnapError | None

    @property
    def refusals(self) -> tuple[str, ...]:
        """Why the device would not allow this deployment, a sentence each; none for one that it allows."""
        why = []
        if self.snap is not None:
            why.append(f"The tubes would snap: {self.snap.found}")
        elif not self.final.stable:
            why.append("The deployed tubes are not stable")
        limits = None if self.system is None else self.system.tubes
        if limits is not None and self.inner_mm > limits.max_extension_mm:
            why.append(
                f"The inner tube comes {self.inner_mm:g} mm out of the scope, more than max_extension_mm = "
                f"{limits.max_extension_mm:g}"
            )
        sweep_mm = None if self.deployed is None else self.deployed.lateral_sweep_mm
        if limits is not None and sweep_mm is not None and sweep_mm > limits.max_lateral_sweep_mm:
            why.append(
                f"The tubes sweep {sweep_mm:.3f} mm sideways, more than max_lateral_sweep_mm = "
                f"{limits.max_lateral_sweep_mm:g}"
            )
        return tuple(why)

    @property
    def acceptable(self) -> bool:
        """Whether the device allows it: stable at every step, and within the limits of the system."""
        return not self.refusals


def load_tubes(name_or_path: str | os.PathLike[str]) -> System | BareTubes:
    """Read a system, as `load_system`, or a TOML file of a name and `[[tubes]]`, the innermost first."""
    given = os.fspath(name_or_path)
    if given.endswith(".toml"):
        mapping = read_toml(given, remedy=_REMEDY)
        if isinstance(mapping.get("tubes"), list):
            return parse(BareTubes, mapping, given, remedy=_REMEDY)
    return load_system(given)


def deploy_tubes(
    device: System | BareTubes,
    outer_mm: float,
    inner_mm: float,
    *,
    rotation_rad: float = 0.0,
    relative_rad: float = 0.0,
) -> TubeAnswer:
    """Turn, insert both tubes, insert the inner one, and look at every step.

    The direction of the inner tube's bend about +z of the scope tip is `rotation_rad` from its +x, as in a
    plan, and the base of the outer tube is turned `relative_rad` farther.  SettingsError is raised if the
    insertions are impossible, nothing comes out, or an angle is more than a turn.
    """
    tubes = tubes_of(device)
    if len(tubes) != 2:
        raise SettingsError(
            f"{device.name} has {len(tubes)} tube{'s' if len(tubes) > 1 else ''}",
            expected="two, of which one is inserted beyond the other",
            remedy="`lungaccess shapes --system FILE` takes one to three tubes",
        )
    if inner_mm == 0.0:
        raise SettingsError(
            "The inner tube stays in the scope",
            expected="an insertion above 0",
            remedy="Insert it, for instance --outer 10 --inner 40",
        )
    if not (abs(rotation_rad) <= MOST_TURN_RAD and abs(relative_rad) <= MOST_TURN_RAD):
        raise SettingsError(
            f"The tubes are to be turned by {rotation_rad:g} and {relative_rad:g} rad",
            expected=f"at most one turn, {MOST_TURN_RAD:.4f} rad, either way",
            remedy="Leave out whole turns: every tenth of a turn is a step that is looked at",
        )
    angles = np.array([rotation_rad, rotation_rad + relative_rad]) + stage.BEND_RAD
    sequence = stage.kuntz2015(tubes, angles, outer_mm, inner_mm)
    shaft = device.tubes.needle_shaft if isinstance(device, System) else None
    mechanics = stage.TubeMechanics(tubes, needle=shaft)
    deployed, snap = None, None
    try:
        deployed = stage.deploy(mechanics, sequence)
        final = deployed.final
    except stage.SnapError as error:
        snap = error
        final = mechanics.given_base_angles(sequence.base_angles_rad[-1], sequence.beta_mm[-1])
    return TubeAnswer(
        name=device.name,
        system=device if isinstance(device, System) else None,
        outer_mm=float(outer_mm),
        inner_mm=float(inner_mm),
        rotation_rad=float(rotation_rad),
        relative_rad=float(relative_rad),
        final=final,
        deployed=deployed,
        snap=snap,
    )


def compare_sequences(answer: TubeAnswer) -> stage.SequenceComparison:
    """Compare the sequences that lead to the same deployment."""
    final = answer.final
    angles = np.array([answer.rotation_rad, answer.rotation_rad + answer.relative_rad]) + stage.BEND_RAD
    inserted, mechanics = (answer.inner_mm, answer.outer_mm), final.mechanics
    return stage.least_sweep_sequence(mechanics.tubes, angles, inserted, needle=mechanics.needle)


def design_choices(answer: TubeAnswer) -> tuple[stage.DesignProposal, tuple[stage.DesignProposal, ...]]:
    """Return the present design, and one proposal for each curved length, the least sweep first.

    Of each length it is the design with the least sweep that reaches about as far to the side as the present
    one, or else the one that reaches farthest.  None sweeps more than the system allows.  SettingsError is
    raised if the tubes are no system: its limits are needed.
    """
    system = answer.system
    if system is None:
        raise SettingsError(
            f"{answer.name} is just tubes without a system",
            expected="a system, whose channel and limits say what can be made",
            remedy="Give a system, not just tubes",
        )
    limits = stage.MakerLimits(channel_diameter_mm=system.scope.channel_diameter_mm)
    present = stage.evaluate_design(system.tubes, answer.outer_mm, answer.inner_mm)
    found = stage.propose_designs(
        system.tubes, answer.outer_mm, answer.inner_mm, system.tubes.max_lateral_sweep_mm, limits
    )
    # Share of the present reach that counts as about as far.
    enough = 0.95 * present.tip_offset_mm

    def rank(each: stage.DesignProposal) -> tuple[float, float, float]:
        return max(enough - each.tip_offset_mm, 0.0), each.lateral_sweep_mm, each.tip_angle_rad

    chosen = [
        min((each for each in found if each.tubes.inner.curved_length_mm == length), key=rank)
        for length in sorted({each.tubes.inner.curved_length_mm for each in found})
    ]
    return present, tuple(sorted(chosen, key=lambda each: each.lateral_sweep_mm))


def tubes_record(answer: TubeAnswer) -> dict[str, Any]:
    """Return a deployment as plain JSON types: mm, rad, frame of the scope tip."""
    deployed, snap = answer.deployed, answer.snap
    return {
        "name": answer.name,
        "tubes": [to_mapping(tube) for tube in answer.final.mechanics.tubes],
        "outer_mm": answer.outer_mm,
        "inner_mm": answer.inner_mm,
        "rotation_rad": answer.rotation_rad,
        "relative_rad": answer.relative_rad,
        "tip_mm": answer.final.base_from_tip[:3, 3].tolist(),
        "tip_direction": answer.final.base_from_tip[:3, 2].tolist(),
        "tip_angles_rad": answer.final.tip_angles_rad.tolist(),
        "allowed": answer.acceptable,
        "refusals": list(answer.refusals),
        "stable": answer.final.stable,
        "least_determinant": answer.final.least_determinant,
        "lateral_sweep_mm": None if deployed is None else deployed.lateral_sweep_mm,
        "follow_the_leader_error_mm": None if deployed is None else deployed.follow_the_leader_error_mm,
        "snap": None
        if snap is None
        else {
            "why": snap.why,
            "move": snap.move,
            "base_angles_rad": snap.base_angles_rad.tolist(),
            "insertions_mm": snap.insertions_mm.tolist(),
        },
    }


def tubes_of(device: System | BareTubes) -> tuple[stage.Tube, ...]:
    """Return the tubes, the innermost first."""
    if isinstance(device, System):
        return device.tubes.nested
    return device.tubes


def design_shapes(device: System | BareTubes) -> stage.TubeShapes:
    """Return the shapes of a design, of bare tubes by default limits; errors: `open_shapes`."""
    limits, needle = stage.ShapeLimits(), None
    if isinstance(device, System):
        stated = device.tubes
        needle = stated.needle_shaft
        limits = stage.ShapeLimits(
            max_extension_mm=stated.max_extension_mm,
            max_lateral_sweep_mm=stated.max_lateral_sweep_mm,
            max_strain=stated.max_strain,
        )
    return stage.open_shapes(tubes_of(device), limits, needle=needle)


COSTS = ("lateral_sweep_mm", "follow_the_leader_error_mm", "strain", "arc_error_mm")
"""The values that are told of every shape of a design beside its tip, in this order."""


def shapes_record(name: str, shapes: stage.TubeShapes) -> dict[str, Any]:
    """Return what a design can do as plain JSON types: mm, rad."""
    tips = shapes.scope_from_tip
    aside = np.hypot(tips[:, 0, 3], tips[:, 1, 3])
    largest = {
        "tip_aside_mm": aside,
        "tip_ahead_mm": tips[:, 2, 3],
        "tip_turned_rad": np.arccos(np.clip(tips[:, 2, 2], -1.0, 1.0)),
        **{cost: getattr(shapes, cost) for cost in COSTS},
    }
    return {
        "name": name,
        "n_tubes": len(shapes.tubes),
        "stop_mm": shapes.grid.stop_mm,
        "relative_rotations": len(np.unique(shapes.rotations_rad, axis=0)),
        "candidates": shapes.candidates,
        "shapes": shapes.count,
        "refused": shapes.refused,
        "largest": {key: float(values.max()) if shapes.count else None for key, values in largest.items()},
        "least_determinant": float(shapes.least_determinant.min()) if shapes.count else None,
    }


def save_shapes(shapes: stage.TubeShapes, path: Path) -> None:
    """Write all shapes as CSV, the innermost tube first, with tip and costs; FileError if it cannot be."""
    n = len(shapes.tubes)
    columns = {
        **{f"insertion_{i + 1}_mm": shapes.insertions_mm[:, i] for i in range(n)},
        **{f"rotation_{i + 1}_rad": shapes.rotations_rad[:, i] for i in range(n)},
        **{f"tip_{axis}_mm": shapes.scope_from_tip[:, i, 3] for i, axis in enumerate("xyz")},
        **{f"tangent_{axis}": shapes.scope_from_tip[:, i, 2] for i, axis in enumerate("xyz")},
        **{cost: getattr(shapes, cost) for cost in ("least_determinant", *COSTS)},
    }
    table = np.stack(list(columns.values()), axis=1)
    with atomic_write(path) as temporary:
        np.savetxt(temporary, table, fmt="%.9g", delimiter=",", header=",".join(columns), comments="")
