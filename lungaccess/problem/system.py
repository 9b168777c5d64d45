"""The whole device: bronchoscope, tubes, needle and margins, read from a preset or a TOML file."""

import functools
import os
import tomllib
from dataclasses import field, replace
from typing import Annotated

import numpy as np
from pydantic import Field

from anatomy.base.checksums import canonical_sha256
from anatomy.base.errors import SettingsError
from anatomy.base.records import LEFT_OUT_IF_EMPTY
from anatomy.base.settings import impossible, parse, quantity, settings, switch, text, to_mapping
from anatomy.margins import Margins
from lungaccess.problem.preset_files import PresetFiles
from lungaccess.problem.tools import Tool, load_tool
from stages.needle.device import Needle
from stages.scope.device import Bronchoscope
from stages.tube.device import ConcentricTubes, Tube

FISSURE_RULES = {True: " (fissures may be crossed)", False: " (fissures are obstacles)"}
"""How the name of a preset ends that was loaded with another rule for fissures than its own."""
_PRESETS = "presets"
_NEEDLES = "presets/needles"
_TUBES = "presets/tubes"
_FILES = PresetFiles(
    what="system",
    folders=(_PRESETS, _TUBES, _NEEDLES),
    remedy="`lungaccess presets --show lung-default` prints a complete file to start from",
)


@settings
class System:
    """Everything a plan depends on besides the patient and the target.

    Args:
        sources: Where the numbers come from; what has no source says "assumption".
        tubes: The outer tube, or the only one, runs in the channel of the scope.
        needle: Runs inside the inner tube.  Without one the tip of the inner tube goes to the target itself.
        needle_preloaded: Whether the needle's tip stays at that of the inner tube while the tubes are
            deployed.  Then it bends with them, and `tubes` know its shaft; else its stiffness is neglected.
        fissures_allowed: Whether tubes and needle may cross a fissure, which pierces the pleura twice.
        max_fissure_chance: With what chance tubes and needle may cross a fissure of which a band is known;
            None for any chance.
        tool: What is done at the target, on the needle.  With one a procedure succeeds if enough of the
            nodule is in it, and without one if the last tip ends near the target.

    Raises:
        SettingsError: If a value is wrong or one device does not fit into the other.
    """

    name: Annotated[str, text("name of the system")]
    description: Annotated[str, text("one sentence for people", may_be_empty=True)] = ""
    sources: Annotated[tuple[str, ...], Field(description="where the numbers come from")] = ()
    scope: Bronchoscope
    tubes: ConcentricTubes
    needle: Needle | None = None
    margins: Margins = Margins()
    needle_preloaded: Annotated[
        bool,
        switch(
            "whether the needle lies in the tubes up to their tip while they are deployed, and bends with "
            "them; if not, its stiffness is neglected"
        ),
    ] = field(default=False, metadata={LEFT_OUT_IF_EMPTY: True})
    fissures_allowed: Annotated[bool, switch("whether a fissure may be crossed")] = False
    max_fissure_chance: Annotated[
        float | None, quantity("greatest chance of crossing a fissure in its band", above=0.0, at_most=1.0)
    ] = field(default=None, metadata={LEFT_OUT_IF_EMPTY: True})
    tool: Tool | None = field(default=None, metadata={LEFT_OUT_IF_EMPTY: True})

    def __post_init__(self) -> None:
        if self.max_fissure_chance is not None and not self.fissures_allowed:
            raise impossible("max_fissure_chance", self.max_fissure_chance, "none: no fissure is allowed")
        outer, channel = self.tubes.outermost.outer_diameter_mm, self.scope.channel_diameter_mm
        name = self.tubes.named[0][0]
        if outer >= channel:
            raise impossible(
                f"tubes.{name}.outer_diameter_mm", outer, f"less than scope.channel_diameter_mm = {channel:g}"
            )
        if self.needle is not None:
            self._check_needle(self.needle)
        elif self.tubes.outer is None or not any(tube.bends for tube in self.tubes.nested):
            # Without a needle the tip of the tubes must come to points in space, not on a line only.
            raise impossible(
                "needle",
                None,
                "the table [needle], or else two tubes or three of which one is bent: the tip of one tube or "
                "of straight ones comes only to a line or surface from each place of the scope",
            )
        if self.tool is not None and self.needle is None:
            raise impossible("tool", self.tool.name, "no table [tool] where there is no [needle] to lead it")
        if self.needle_preloaded:
            self._check_shaft()
        # The shaft bends with the tubes while they are deployed, if it is in them then.
        shaft = self.needle_tube if self.needle_preloaded else None
        object.__setattr__(self, "tubes", self.tubes.with_needle(shaft))

    def _check_needle(self, needle: Needle) -> None:
        bore = self.tubes.inner.inner_diameter_mm
        if needle.diameter_mm >= bore:
            raise impossible(
                "needle.diameter_mm",
                needle.diameter_mm,
                f"less than tubes.inner.inner_diameter_mm = {bore:g}",
            )
        # Tubes that share a bend are bent by no more than the most bent of them is at rest.
        at_rest = [tube.max_precurvature_per_mm for tube in self.tubes.nested]
        bent = max(self.tubes.channel_curvature_per_mm, *at_rest)
        most = needle.most_bent_per_mm(self.tubes.passing_mm + needle.max_length_mm)
        if bent > most:
            raise impossible(
                "needle.diameter_mm",
                needle.diameter_mm,
                f"at most {needle.diameter_mm * most / bent:.3g}: channel and tubes bend the needle by "
                f"{bent:.4g} / mm, so that its strain exceeds needle.max_strain = "
                f"{needle.max_strain:g}. Slots (needle.slotted_segments) or a smaller "
                "tubes.max_channel_curvature_per_mm allow more",
            )

    def _check_shaft(self) -> None:
        """What slides through bent tubes while the needle is inserted must be alike, or they move."""
        shaft = self.needle_tube
        if shaft is None:
            return
        slides_mm = self.tubes.curved_out_mm + self.require_needle("Its shaft").max_length_mm
        parts = shaft.parts
        stiffness = parts.stiffness_n_mm2[parts.begin_mm < slides_mm]
        if self.tubes.curved_out_mm > 0.0 and np.ptp(stiffness) > 0.0:
            raise impossible(
                "needle.slotted_segments",
                len(shaft.slotted_segments),
                f"none, or one from the tip on of at least {slides_mm:g} mm, where needle_preloaded is true: "
                "so much of the shaft comes to lie in bent tubes, and where its stiffness changes the tubes "
                "would move while it is inserted",
            )

    @property
    def stages(self) -> tuple[str, ...]:
        """The devices that go one through the other, the first to move first."""
        return ("scope", "tube") if self.needle is None else ("scope", "tube", "needle")

    @property
    def needle_tube(self) -> Tube | None:
        """The needle's shaft as one more, straight tube; None without one or if its stiffness is neglected.

        It is as long as it has to be to come out of the inner tube by its `max_length_mm`.
        """
        needle = self.needle
        if needle is None or needle.youngs_modulus_gpa == 0.0:
            return None
        ends = (segment.to_mm for segment in needle.slotted_segments)
        return Tube(
            outer_diameter_mm=needle.diameter_mm,
            inner_diameter_mm=needle.inner_diameter_mm,
            length_mm=max(self.tubes.inner.length_mm + needle.max_length_mm, *ends, 0.0),
            slotted_segments=needle.slotted_segments,
            youngs_modulus_gpa=needle.youngs_modulus_gpa,
            poisson_ratio=needle.poisson_ratio,
        )

    @property
    def track_radius_mm(self) -> float:
        """Radius of what goes to the target: of the needle, or of the inner tube where there is none."""
        return self.tubes.inner.radius_mm if self.needle is None else self.needle.radius_mm

    @property
    def needle_sizes(self) -> tuple[str, str]:
        """Diameter and least radius of curvature of the needle, mm, as tables say them."""
        if self.needle is None:
            return "none", "none"
        return f"{self.needle.diameter_mm:g}", f"{self.needle.min_radius_of_curvature_mm:.0f}"

    def require_needle(self, use: str) -> Needle:
        """Return the needle; SettingsError without one, which begins with what needs it."""
        if self.needle is None:
            raise SettingsError(
                f"{use} needs a needle, and the system {self.name!r} has none",
                expected="a system with the table [needle]",
                remedy="Name a preset with a needle, such as lung-default, or add [needle] to the file",
            )
        return self.needle


def preset_names() -> tuple[str, ...]:
    """Return the names of the systems that ship with the package, sorted."""
    return _FILES.names_in(_PRESETS)


needle_preset_names = functools.partial(_FILES.names_in, _NEEDLES)
"""Returns those for the needle stage alone: published needles; scope and tubes are as large as these need."""
tube_preset_names = functools.partial(_FILES.names_in, _TUBES)
"""Returns those with tubes turned one against the other; no choice tries them: their atlas takes minutes."""
shipped_names = _FILES.names
"""Returns the names of all of them."""
preset_text = _FILES.text
"""Returns the TOML text of a preset, with its comments; SettingsError if there is none so called."""


def load_system(name_or_path: str | os.PathLike[str], *, fissures_allowed: bool | None = None) -> System:
    """Read a system from a preset or from a TOML file.

    Args:
        name_or_path: Name of a preset (see `preset_names`), or path of a file that ends in ``.toml``.
        fissures_allowed: Whether fissures may be crossed, instead of what the system says; its name then says
            so, too.

    Raises:
        SettingsError: If there is no such preset, the file is not TOML, or a value in it is wrong.
        FileError: If the file cannot be read.

    Examples:
        >>> load_system("lung-default").needle.diameter_mm
        0.8
    """
    given = os.fspath(name_or_path)
    loaded = parse(System, _FILES.read(name_or_path), given, remedy=_FILES.remedy)
    require_own_name(loaded, given)
    return with_fissure_rule(loaded, fissures_allowed)


def with_fissure_rule(system: System, fissures_allowed: bool | None) -> System:
    """Return a system that may cross fissures or not, with a name that says so; itself for None."""
    if fissures_allowed is None or fissures_allowed == system.fissures_allowed:
        return system
    name = system.name + FISSURE_RULES[fissures_allowed]
    return replace(system, name=name, fissures_allowed=fissures_allowed)


def with_fissure_chance(system: System, chance: float | None) -> System:
    """Return a system that may cross a fissure with so much chance, and says so in its name; itself for None.

    Raises:
        SettingsError: If the chance is not above 0 and at most 1.
    """
    if chance is None:
        return system
    name = f"{system.name} (crosses a fissure with a chance of at most {chance:g})"
    return replace(system, name=name, fissures_allowed=True, max_fissure_chance=chance)


def with_tool(system: System, tool: Tool | None) -> System:
    """Return a system with a tool, and with a name that says so; itself for None."""
    if tool is None or tool == system.tool:
        return system
    before = "" if system.tool is None else f" ({system.tool.name})"
    return replace(system, tool=tool, name=f"{system.name.removesuffix(before)} ({tool.name})")


def systems_with_tool(systems: tuple[System, ...], name_or_path: str | None) -> tuple[System, ...]:
    """Return systems with a tool of a name or file, of several those with a needle; themselves for None."""
    if name_or_path is None:
        return systems
    able = [system for system in systems if system.needle is not None or len(systems) == 1]
    return tuple(with_tool(system, load_tool(name_or_path)) for system in able)


def preset_named(name: str) -> System | None:
    """Return the preset with which `load_system` made a system of this name; None if there is none.

    Examples:
        >>> preset_named("ultrathin (fissures may be crossed)").fissures_allowed
        True
    """
    for allowed, rule in FISSURE_RULES.items():
        if name.endswith(rule):
            return _preset(name.removesuffix(rule), allowed)
    return _preset(name, None)


@functools.cache
def _preset(name: str, fissures_allowed: bool | None) -> System | None:
    if name not in shipped_names():
        return None
    loaded = parse(System, tomllib.loads(_FILES.text(name)), name)
    if fissures_allowed is None:
        return loaded
    return replace(loaded, name=name + FISSURE_RULES[fissures_allowed], fissures_allowed=fissures_allowed)


def require_own_name(system: System, where: str = "The system") -> None:
    """Refuse, by a SettingsError, a system that bears the name of a preset and is not that preset."""
    preset = preset_named(system.name)
    if preset is None or preset == system:
        return
    raise SettingsError(
        f"{where} is named {system.name!r} like a preset and differs from it",
        expected="a name of its own for a device of its own",
        remedy='Change the line `name = "..."`, or system.name in Python',
    )


def system_fingerprint(system: System) -> str:
    """Return the SHA-256 (hex) of the canonical JSON of a system: equal settings, equal fingerprint."""
    return canonical_sha256(to_mapping(system))
