"""A table of limits that masks of a patient must keep, whatever program made them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace

from anatomy.base.errors import AnatomyError, SettingsError
from anatomy.base.records import frozen_value
from anatomy.base.words import percent

FITS, DOUBTFUL, REFUSED, ACCEPTED = "fits", "doubtful", "refused", "accepted"
"""What a check finds: usual; unusual, which is a warning; impossible; and that, accepted by its name."""

CHECKS: Mapping[str, str] = {
    "axes": "the trachea runs upwards, and the spine is behind: the header is right",
    "sides": "left and right are not exchanged",
    "airway": "trachea and bronchi form a tree as wide as airways are",
    "gap": "no large part of the airway is cut off from the trachea",
    "bronchi": "a bronchus leads into each lung",
    "one-lung": "there are two lungs",
    "volume": "the lungs are as large as lungs can be",
    "lung": "the lungs are whole, filled, and nothing else is in their mask",
    "vessels": "vessels lie in the lungs, in all their parts, and are as many as there can be",
    "overlap": "no mask is the copy of another one",
    "wall": "the wall lies around the lumen",
    "fissures": "fissures are thin sheets in the lungs",
    "lobes": "the lobes lie where they belong, and make up the lungs",
    "nodules": "nodules lie in or at the lungs, and are as large as nodules can be",
    "grid": "the masks lie within the images",
    "density": "the lungs are as dense as lungs can be",
    "masks": "masks from elsewhere lie on what they show in the CT",
}
"""The checks, by the name that `--accept` takes."""


@frozen_value
class Finding:
    """What a check of `CHECKS` found: a sentence, between which limits, what to do, and the verdict."""

    name: str
    found: str
    remedy: str = ""
    verdict: str = REFUSED

    @property
    def warning(self) -> str:
        """The sentence that commands, pages and records show as a warning; empty if all is usual."""
        if self.verdict == FITS:
            return ""
        if self.verdict == DOUBTFUL:
            return self.found
        how = "was accepted" if self.verdict == ACCEPTED else "is not accepted yet"
        return f"{self.found}. The check {self.name} fails, which {how}."


@frozen_value
class Limit:
    """Between which values a figure of the masks is usual, and between which it is possible.

    The check is a key of `CHECKS`.  The sentence has a place for the figure, which is a share if no form is
    stated.  Beyond the usual values is a warning, beyond the possible ones a refusal; the reason says where
    the limits are from.
    """

    check: str
    words: str
    usual: tuple[float, float]
    possible: tuple[float, float] = (0, 1)
    reason: str
    remedy: str = "Check that the file shows what its name or role says, and belongs to these images"
    form: str = ""

    def finding(self, value: float) -> Finding:
        """Return what a figure means."""
        inside = [least <= value <= most for least, most in (self.usual, self.possible)]
        verdict = FITS if inside[0] else DOUBTFUL if inside[1] else REFUSED
        what = "possible" if verdict == REFUSED else "usual"
        ends = self.possible if verdict == REFUSED else self.usual
        low, high = (_written(self.form, end) for end in ends)
        limits = (
            f"{low} or more" if ends[1] == MOST else f"up to {high}" if ends[0] == 0 else f"{low} to {high}"
        )
        return Finding(
            name=self.check,
            found=f"{self.words.format(_written(self.form, value))}; {limits} is {what} ({self.reason})",
            remedy=self.remedy,
            verdict=verdict,
        )


def _written(form: str, value: float) -> str:
    return form.format(value) if form else percent(value)


MOST = float("inf")
LIMITS: Mapping[str, Limit] = {
    "lungs_l": Limit(
        check="volume", words="The lungs have {}", form="{:.2f} l", usual=(1.5, 9.0),
        possible=(0.3, 11.0), reason="from a child of one year after breathing out to a very tall man "
        "after breathing in", remedy="Check the voxel size in the header, and look at the masks",
    ),
    "tall_lungs": Limit(
        check="volume", words="The lungs are {} times as tall as both are wide", form="{:.2f}",
        usual=(0.6, 1.5), possible=(0.25, 4), reason="phantoms have 0.9 to 1; lungs are 20 to 30 cm "
        "tall and 22 to 30 cm wide", remedy="Check the distance of the slices in the header, and look "
        "whether a lung is missing",
    ),
    "smaller_lung": Limit(
        check="one-lung", words="{} of the lungs lie on the side of the carina that has less of them",
        usual=(0.25, 0.5), possible=(0.05, 0.5), reason="the left lung has 45 %; a lung that has "
        "collapsed has 10 %", remedy="Look whether the other lung is solid, taken out, or missing in "
        "the mask",
    ),
    "lung_pieces": Limit(
        check="lung", words="{} of the lungs are pieces apart from both", usual=(0, 0.02),
        possible=(0, 0.2), reason="two lungs are two pieces, in phantoms and patients",
        remedy="Remove what is no lung: stomach, bowel, table",
    ),
    "lung_holes": Limit(
        check="lung", words="Holes in the lungs take {} of them", usual=(0, 0.05), possible=(0, 0.5),
        reason="a filled mask has none; a mass or unfilled vessels take 5 %", remedy="Fill the mask: "
        "what is a hole is an obstacle",
    ),
    "lumen_ml": Limit(
        check="airway", words="The airway lumen has {}", form="{:.1f} ml", usual=(8, 200),
        possible=(2, 500), reason="20 to 120 ml are seen in CT; a child of one year has 5 ml",
    ),
    "lumen_end_mm2": Limit(
        check="airway", words="The airway ends below with {} of lumen in one slice", form="{:.0f} mm2",
        usual=(0, 30), possible=(0, MOST), reason="the lowest bronchus of phantoms ends with 3 to 8 mm2; "
        "where their masks are cut in the lungs there are 60 and more", remedy="Look whether the mask of the "
        "airway goes on: what lies behind its end is not reached",
    ),
    "lumen_holes": Limit(
        check="airway", words="Holes in the lumen take {} of it", usual=(0, 0.02), possible=(0, 0.2),
        reason="a lumen has none, a wall has its lumen",
    ),
    "trachea_mm": Limit(
        check="airway", words="The trachea has the radius {}", form="{:.1f} mm", usual=(4, 14),
        possible=(1.5, 22), reason="adults have 5 to 14 mm, infants 2 mm",
    ),
    "thinnest_mm": Limit(
        check="airway", words="Half of the ends of the airway have a radius of {} or more",
        form="{:.1f} mm", usual=(0, 2.2), possible=(0, 6), reason="CT shows bronchi down to 1 mm; "
        "wider ends are those of a tree that is cut, or of a mask that was widened",
    ),
    "widening": Limit(
        check="airway", words="A branch of the airway is up to {} times as wide as the one it leaves",
        form="{:.1f}", usual=(0, 2.2), possible=(0, MOST), reason="a branch is thinner; where it "
        "begins phantoms have up to 1.6 times, a ball that leaked into the lung 3 times and more",
        remedy="Look for a leak of the airway into the lung, which would be taken as free for the scope",
    ),
    "ends_in_lungs": Limit(
        check="bronchi", words="{} of the ends of the airway lie in the lungs", usual=(0.85, 1),
        possible=(0.4, 1), reason="98 % and more do in phantoms and patients", remedy="Look whether a "
        "part of the lungs is missing, or a mask lies beside the others",
    ),
    "least_ends": Limit(
        check="bronchi", words="The lung with fewer ends of the airway has {}", form="{:.0f}",
        usual=(4, MOST), possible=(1, MOST), reason="a lung has three lobes or two, with some segments "
        "each; reach in that lung is understated", remedy="Look where the mask of the airway stops",
    ),
    "vessels_of_lungs": Limit(
        check="vessels", words="Vessels take {} of the lungs", usual=(0.004, 0.15),
        possible=(0.0005, 0.4), reason="large vessels take 1 %, all that CT shows 3 to 8 %",
    ),
    "vessels_in_lungs": Limit(
        check="vessels", words="{} of the vessels lie in the lungs", usual=(0.5, 1), possible=(0.2, 1),
        reason="all do, or two thirds where the mask has the vessels of the mediastinum too",
        remedy="Check the header of the mask of the vessels: it may have lost its place",
    ),
    "least_vessels": Limit(
        check="vessels", words="The part of the lungs with the fewest vessels has {} of their mean share",
        usual=(0.1, 1), possible=(0.01, 1), reason="of three parts of each lung, from apex to base, "
        "none is without", remedy="Look whether vessels are missing there: none is avoided",
    ),
    "vessels_in_lumen": Limit(
        check="overlap", words="{} of vessels or lumen, the smaller one, lie in the other one",
        usual=(0, 0.02), possible=(0, 0.3), reason="a voxel is one or the other; masks of two programs "
        "may share 5 %",
    ),
    "wall_in_lumen": Limit(
        check="overlap", words="{} of wall or lumen, the smaller one, lie in the other one",
        usual=(0, 0.05), possible=(0, 0.8), reason="a voxel is one or the other, or the wall is filled",
    ),
    "wall_in_vessels": Limit(
        check="overlap", words="{} of wall or vessels, the smaller one, lie in the other one",
        usual=(0, 0.4), possible=(0, 0.9), reason="vessels touch walls, and where they do a voxel may "
        "be both",
    ),
    "wall_at_lumen": Limit(
        check="wall", words="{} of the wall lie at the lumen", usual=(0.8, 1), possible=(0.4, 1),
        reason="walls are up to 3 mm thick",
    ),
    "least_wall": Limit(
        check="wall", words="The part of the airway with the least wall has a wall along {}",
        usual=(0.5, 1), reason="all has one; where the mask shows none, the margins alone cover it",
        remedy="Look where the mask of the wall stops",
    ),
    "fissures_of_lungs": Limit(
        check="fissures", words="Fissures take {} of the lungs", usual=(0.002, 0.05), possible=(0, 0.2),
        reason="a sheet of two voxels takes 1 to 2 %",
    ),
    "fissures_in_lungs": Limit(
        check="fissures", words="{} of the fissures lie in the lungs", usual=(0.9, 1), possible=(0.5, 1),
        reason="99 % do in phantoms and patients",
    ),
    "fissures_at_rim": Limit(
        check="lung", words="{} of the fissures lie at the surface of the lungs", usual=(0.02, 1),
        reason="fissures open at the surface, where phantoms have 10 % of them within 3 mm",
        remedy="Look whether the mask of the lungs is wider than the lungs",
    ),
    "least_fissures": Limit(
        check="fissures", words="The part of the lungs with the fewest fissures has {} of their mean "
        "share", usual=(0.1, 1), reason="of three parts of each lung, from apex to base, the oblique "
        "fissure crosses all", remedy="Look whether fissures are missing there: none is avoided",
    ),
    "fissures_thick": Limit(
        check="fissures", words="{} of the fissures are thick", usual=(0, 0.005), reason="they are thin "
        "sheets; of the vessels of phantoms 9 % are thick", remedy="Look whether the masks of fissures "
        "and vessels are exchanged",
    ),
    "fissures_in_others": Limit(
        check="overlap", words="{} of the fissures lie in vessels or airway", usual=(0, 0.2),
        possible=(0, 0.7), reason="they are crossed by few vessels",
    ),
    "lobes_of_lungs": Limit(
        check="lobes", words="The lobes take {} of the lungs", usual=(0.85, 1), possible=(0.3, 1),
        reason="all but airways and vessels is of a lobe",
    ),
    "lobes_on_side": Limit(
        check="lobes", words="{} of the lobes lie on their side of the carina", usual=(0.9, 1),
        possible=(0.6, 1), reason="a lung reaches little beyond the middle", remedy="Check the labels "
        "of the lobes, and whether their mask is mirrored",
    ),
    "nodules_ml": Limit(
        check="nodules", words="Nodules have {}", form="{:.3f} ml", usual=(0.004, 120), possible=(0, 500),
        reason="a nodule of 2 mm has 0.004 ml, a mass of 6 cm 113 ml",
    ),
    "targets_in_nodules": Limit(
        check="nodules", words="{} of the stated targets lie in a nodule", usual=(1, 1),
        reason="a target is a nodule of the mask, or is none", remedy="Look whether a nodule is "
        "missing in the mask, or lies elsewhere",
    ),
    "nodule_end": Limit(
        check="nodules", words="The first or last slice of a nodule has {} of its largest slice",
        usual=(0, 0.75), reason="nodules are round; a flat end is seen where a mask or image was cut",
        remedy="Look whether the nodule is whole",
    ),
    "nodule_pieces": Limit(
        check="nodules", words="Up to {} nodules that do not touch have the same label", form="{:.0f}",
        usual=(0, 1), possible=(0, MOST), reason="a label is one nodule, and its middle the target, "
        "which lies between its pieces", remedy="Give each nodule a label of its own",
    ),
    "nodules_at_lungs": Limit(
        check="nodules", words="{} of the nodules lie in or at the lungs", usual=(0.999, 1),
        possible=(0.5, 1), reason="a nodule that a mask of the lungs leaves out still touches it",
        remedy="Check the header of the mask of the nodules, and that it shows nothing else",
    ),
    "nodules_beyond_lungs_mm": Limit(
        check="nodules", words="Nodules reach {} beyond the lungs, and count as lung there",
        form="{:.1f} mm", usual=(0, 1), possible=(0, MOST), reason="a mask of the lungs may leave out "
        "a nodule at the pleura, and one of nodules may be wide", remedy="Look whether a nodule "
        "reaches into the chest wall or the mediastinum",
    ),
    "nodule_filled": Limit(
        check="nodules", words="The largest nodule fills {} of the box around it", usual=(0.15, 1),
        possible=(0.02, 1), reason="a ball fills 52 %; sheets and trees fill little",
    ),
    "nodules_in_others": Limit(
        check="overlap", words="{} of the nodules lie in vessels or airway", usual=(0, 0.5),
        possible=(0, 0.9), reason="a target that is all obstacle cannot be reached",
    ),
}  # fmt: skip
"""The figures of masks of a patient.  Limits are from phantoms and published volumes."""


def findings_of(figures: Mapping[str, float]) -> list[Finding]:
    """Return what figures mean, by the names of `LIMITS`."""
    return [limit.finding(figures[name]) for name, limit in LIMITS.items() if name in figures]


def with_accepted(findings: Iterable[Finding], names: Collection[str]) -> tuple[Finding, ...]:
    """Return findings in which those that fail are accepted by their names."""
    return tuple(
        replace(each, verdict=ACCEPTED) if each.verdict == REFUSED and each.name in names else each
        for each in findings
    )


def require_plausible(findings: Collection[Finding], accepted: Collection[str]) -> tuple[str, ...]:
    """Return the names of the checks that failed and are accepted.

    Raises AnatomyError if a check failed that is not.
    """
    failed = [each for each in findings if each.verdict in (REFUSED, ACCEPTED)]
    refused = [each for each in with_accepted(failed, accepted) if each.verdict == REFUSED]
    if refused:
        names = " ".join(f"--accept {name}" for name in dict.fromkeys(check.name for check in refused))
        raise AnatomyError(
            "; ".join(check.found for check in refused),
            expected="; ".join(dict.fromkeys(CHECKS[check.name] for check in refused)),
            remedy="; ".join(dict.fromkeys(check.remedy for check in refused))
            + f"; if the masks are right all the same, add {names}",
        )
    return tuple(dict.fromkeys(check.name for check in failed))


def require_known_checks(names: Collection[str]) -> None:
    """Refuse names that are not in `CHECKS`."""
    unknown = [name for name in names if name not in CHECKS]
    if unknown:
        raise SettingsError(
            f"--accept names {', '.join(unknown)}, which is no check",
            expected=f"one of {', '.join(CHECKS)}",
            remedy="Take the name from the message that refuses the masks",
        )


def warnings_of_findings(findings: Iterable[Finding]) -> Iterator[str]:
    """Yield the sentence of every finding that is not usual."""
    yield from filter(None, (each.warning for each in findings))
