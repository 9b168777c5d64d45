"""The cases of `synthetic-v1` as files: masks, targets, devices and scope tips, for planners in any language.

```
FOLDER/benchmark.json              version, rules, phantoms, hash of the manifest
FOLDER/devices/NAME.toml, .json    the three devices
FOLDER/adult-01/patient.toml ...   a patient of every phantom, as `lungaccess phantom` writes it, without a CT
FOLDER/adult-01/case.json          its queries: name, device, target
FOLDER/adult-01/tips-NAME.json     for each device, where a scope can stand, with the motion that leads there
```

`benchmark.json` is written last, so that a folder that has it is complete.  The tips let a planner start from
a bronchoscope without having one of its own: a submission names one by number.
"""

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import numpy as np

from anatomy.base.errors import AnatomyError, FileError, SettingsError
from anatomy.base.files import read_json, require_writable_folder, write_json, write_text
from anatomy.base.records import frozen_value
from anatomy.base.settings import to_mapping
from anatomy.lung import Lung
from anatomy.patient import PatientImages
from anatomy.phantom import Phantom, make_phantom, write_phantom
from anatomy.phantom.patient import Size
from anatomy.phantom.traits import Lobe, Traits
from lungaccess.planning.coupled.atlas import motions_of
from lungaccess.problem.system import load_system, preset_text

VERSION = "synthetic-v1"
"""Name of the benchmark; other phantoms, targets, devices or rules are another version."""
Family = Literal["adult", "child", "resected", "emphysematous", "breathing"]
FAMILIES: tuple[Family, ...] = ("adult", "child", "resected", "emphysematous", "breathing")
OF_A_FAMILY = 10
SYSTEMS = ("thin-scope", "ultrathin", "therapeutic-scope")
"""The three devices: presets, as `lungaccess presets NAME` prints them."""
TARGETS_A_LUNG = 10
ADULT_MM, CHILD_MM = 1.0, 0.8
"""Edges of the voxels: those of a usual reconstruction, finer for the narrower airways of a child."""
BRONCHUS_LENGTH, VESSEL_LIMIT_MM, VESSEL_RIM_MM, HILAR_VESSEL_MM = 1.35, 0.9, 5.0, 9.0
"""Set so that the medians of a phantom come near those of two patients' masks, see the measurements."""
LOBES: tuple[Lobe, ...] = ("right upper", "left upper", "right lower", "left lower", "right middle")


@frozen_value
class BenchmarkPhantom:
    """One phantom of the benchmark; its name is family and number, such as "adult-01".

    One that breathes comes with the motion of its breath.
    """

    name: str
    family: Family
    number: int
    seed: int
    size: Size
    spacing_mm: float
    traits: Traits
    breathes: bool


def benchmark_phantoms() -> tuple[BenchmarkPhantom, ...]:
    """Return the phantoms, the first of each family first: so any beginning has all families."""
    return tuple(_phantom(family, number) for number in range(1, OF_A_FAMILY + 1) for family in FAMILIES)


def phantom_named(name: str) -> BenchmarkPhantom:
    """Return the phantom of that name; SettingsError if there is none."""
    for each in benchmark_phantoms():
        if each.name == name:
            return each
    raise SettingsError(
        f"{VERSION} has no phantom {name!r}",
        expected=f"a family and a number from 01 to {OF_A_FAMILY}, families: {', '.join(FAMILIES)}",
        remedy="Name one such as adult-01",
    )


def _phantom(family: Family, number: int) -> BenchmarkPhantom:
    """Spread the traits evenly over the numbers, each in another order, so that no two go together."""
    child = family == "child"
    traits = Traits(
        stature=_spread(0.95, 1.13, number, 3),
        flow_exponent=_spread(1.9, 2.1, number, 7),
        vessel_calibre=_spread(1.3, 1.7, number, 1),
        bronchus_length=BRONCHUS_LENGTH,
        vessel_limit_mm=VESSEL_LIMIT_MM,
        vessel_rim_mm=VESSEL_RIM_MM,
        hilar_vessel_mm=HILAR_VESSEL_MM,
        # These shares of the fissures are open in turn: every second phantom has complete ones.
        open_fissures=(0.0, 0.45)[number % 2],
        resected=LOBES[(number - 1) % len(LOBES)] if family == "resected" else "",
        emphysema=_spread(0.3, 1.0, number, 9) if family == "emphysematous" else 0.0,
    )
    return BenchmarkPhantom(
        name=f"{family}-{number:02d}",
        family=family,
        number=number,
        # Seeds run on from here, so that no phantom of the tests or of the documentation is among them.
        seed=28_000 + 100 * FAMILIES.index(family) + number,
        size="small" if child else "adult",
        spacing_mm=CHILD_MM if child else ADULT_MM,
        traits=traits,
        breathes=family == "breathing",
    )


def _spread(low: float, high: float, number: int, stride: int) -> float:
    """Return one of ten evenly spaced values; a stride without a common factor with 10 meets each once."""
    return round(low + (high - low) * ((number * stride) % OF_A_FAMILY) / (OF_A_FAMILY - 1), 4)


MANIFEST = "manifest.json"
MASKS = ("lumen", "wall", "vessels", "lung", "fissures")
"""An answer depends on these masks; CT, labels and lobes are for looking at."""
Point = tuple[float, float, float]


@frozen_value
class Entry:
    """What is fixed of one phantom: the hash of grid and masks, and its targets, LPS mm."""

    masks_sha256: str
    targets_lps: tuple[Point, ...]


def masks_sha256(images: PatientImages) -> str:
    """Return the SHA-256 (hex) of grid and masks: what is written to files, whatever compresses them."""
    digest = hashlib.sha256()
    # NIfTI keeps the grid in single precision: what was read from files has the hash of what was written.
    grid = np.asarray(images.grid.lps_from_ijk, dtype="<f4") + np.float32(0.0)
    digest.update(json.dumps([list(images.grid.shape), grid.tolist()]).encode())
    for name in MASKS:
        volume = getattr(images, name)
        digest.update(name.encode())
        voxels = np.zeros(0, dtype=np.bool_) if volume is None else np.asarray(volume.array > 0).T
        digest.update(np.packbits(voxels).tobytes())
    return digest.hexdigest()


@cache
def entries() -> Mapping[str, Entry]:
    """Return the manifest by the names of the phantoms."""
    content = json.loads(files(__package__).joinpath(MANIFEST).read_text(encoding="utf-8"))
    return {
        name: Entry(
            masks_sha256=entry["masks_sha256"],
            targets_lps=tuple((float(x), float(y), float(z)) for x, y, z in entry["targets_lps"]),
        )
        for name, entry in content["phantoms"].items()
    }


@cache
def manifest_sha256() -> str:
    """Return the SHA-256 (hex) of the manifest: the benchmark in one number."""
    return hashlib.sha256(files(__package__).joinpath(MANIFEST).read_bytes()).hexdigest()


def unproved_phantom(case: BenchmarkPhantom) -> Phantom:
    """Make a phantom, whether or not it is that of the manifest."""
    made = make_phantom(
        seed=case.seed, size=case.size, spacing_mm=case.spacing_mm, traits=case.traits, precise=True
    )
    return replace(made, images=replace(made.images, name=case.name))


def make_benchmark_phantom(case: BenchmarkPhantom) -> Phantom:
    """Make a phantom; AnatomyError if another generator, or library below it, makes other masks."""
    made = unproved_phantom(case)
    remedy = "Install the versions that constraints.txt names; a changed generator needs a new version"
    require_masks(case.name, made.images, f"of {case.name} made here", remedy)
    return made


def require_masks(name: str, images: PatientImages, which: str, remedy: str) -> None:
    """Raise AnatomyError unless the masks of a phantom, which the words tell, are those of the manifest."""
    wanted, found = entries()[name].masks_sha256, masks_sha256(images)
    if found != wanted:
        expected = f"{wanted[:16]}, as the manifest of {VERSION} says"
        raise AnatomyError(f"The masks {which} have the hash {found[:16]}", expected=expected, remedy=remedy)


BENCHMARK, CASE = "benchmark.json", "case.json"
RULES = (
    "A query is a phantom, a device and a target; a planner may use all files of FOLDER but no other answer.",
    "The needle ends at the target, within the check's tolerance of a micrometre; fissures and bullae may "
    "not be crossed; the device's own margins are kept.",
    "A query is solved if the independent check of lungaccess accepts the answer; nothing else counts.",
    "Time is the processor time of one query on one thread, without reading the patient and without what "
    "does not depend on the target; who submits states it, and on which machine.",
    "Cost is the integral of 1 / clearance over the needle [Kuntz2015, eq. 1], as the check recomputes it.",
    "A planner may claim that a target cannot be reached; an accepted answer of anybody refutes the claim.",
)
Progress = Callable[[str, float], None]


@frozen_value
class BenchmarkQuery:
    """One query: its name "PHANTOM/DEVICE/NN", the phantom, the preset of the device, and the target."""

    name: str
    phantom: str
    system: str
    target: int
    target_lps: Point


def _queries_of(case: BenchmarkPhantom) -> Iterator[BenchmarkQuery]:
    """Yield the queries of a phantom, device by device."""
    for system in SYSTEMS:
        for number, point in enumerate(entries()[case.name].targets_lps, start=1):
            name = f"{case.name}/{system}/{number:02d}"
            yield BenchmarkQuery(name=name, phantom=case.name, system=system, target=number, target_lps=point)


def all_queries() -> dict[str, BenchmarkQuery]:
    """Return all queries by name."""
    return {query.name: query for case in benchmark_phantoms() for query in _queries_of(case)}


def write_benchmark(
    folder: Path,
    names: Iterable[str] = (),
    *,
    with_ct: bool = False,
    with_tips: bool = True,
    progress: Progress | None = None,
) -> tuple[BenchmarkPhantom, ...]:
    """Make phantoms and write their cases; a phantom that the folder holds already is left as it is.

    Args:
        names: Of the phantoms; all of them if empty.
        with_ct: Whether to write CTs, 25 MB each, which no rule needs.

    Raises:
        SettingsError: If there is no such phantom.
        AnatomyError: If a phantom is not that of the manifest.
        FileError: If a file cannot be written.
    """
    cases = tuple(phantom_named(name) for name in names) or benchmark_phantoms()
    say = progress or (lambda _words, _share: None)
    devices = require_writable_folder(folder / "devices")
    for name in SYSTEMS:
        write_text(devices / f"{name}.toml", preset_text(name))
        write_json(devices / f"{name}.json", to_mapping(load_system(name)))
    for number, case in enumerate(cases):
        say(f"making {case.name}", number / len(cases))
        home = folder / case.name
        if not (home / CASE).is_file():
            _write_case(case, home, with_ct=with_ct, with_tips=with_tips)
    present = [case.name for case in benchmark_phantoms() if (folder / case.name / CASE).is_file()]
    about = {"benchmark": VERSION, "manifest_sha256": manifest_sha256(), "rules": list(RULES)}
    write_json(folder / BENCHMARK, {**about, "devices": list(SYSTEMS), "phantoms": present})
    return cases


def _write_case(case: BenchmarkPhantom, home: Path, *, with_ct: bool, with_tips: bool) -> None:
    from anatomy.build import build_lung
    from anatomy.io.patients import load_patient

    write_phantom(make_benchmark_phantom(case), home, breathing=case.breathes, with_ct=with_ct)
    if with_tips:
        lung = build_lung(load_patient(home))
        for name in SYSTEMS:
            write_json(home / _tips_file(name), _scope_tips(lung, name))
    queries = [
        {"name": query.name, "device": query.system, "target_lps": list(query.target_lps)}
        for query in _queries_of(case)
    ]
    about = {"benchmark": VERSION, "phantom": case.name, "family": case.family, "seed": case.seed}
    hashed = {"masks_sha256": entries()[case.name].masks_sha256, "traits": asdict(case.traits)}
    write_json(home / CASE, {**about, **hashed, "queries": queries})


def require_cases(folder: Path) -> tuple[BenchmarkPhantom, ...]:
    """Return the phantoms that a folder holds; FileError if it is none of this benchmark as it is now."""
    remedy = f"Make it with: lungaccess benchmark {VERSION} make --out {folder}"
    content = read_json(folder / BENCHMARK, expected="what `make` wrote", remedy=remedy)
    stated = content.get("manifest_sha256") if isinstance(content, dict) else None
    if stated != manifest_sha256():
        raise FileError(
            f"{folder / BENCHMARK} has the manifest {str(stated)[:16]}",
            expected=f"{manifest_sha256()[:16]}, that of {VERSION} in this version of lungaccess",
            remedy=remedy,
        )
    return tuple(phantom_named(str(name)) for name in content["phantoms"])


def _tips_file(system: str) -> str:
    """Return the name of the file of tips of a device, in the folder of a phantom."""
    return f"tips-{system}.json"


def _scope_tips(lung: Lung, system: str) -> dict[str, Any]:
    """Return places where the scope of a device can stand, each with the motion that leads there.

    `lps_from_entry` is one for all; each of `tips` has `lps_from_tip` (4x4, LPS mm) and `states` of advance
    in mm, twist and bend in rad; see `lungaccess.plans.parts.ScopeInsertion`.
    """
    # The tips lie this far apart along the airway: a handful in every segmental bronchus.
    motions = motions_of(lung, load_system(system), 5.0)
    found = []
    for number in range(motions.count):
        motion = motions.motion(number)
        # States are rounded to so many in mm and rad: the check allows a micrometre at the tip.
        states = motion.states.round(7).tolist()
        found.append({"lps_from_tip": motion.lps_from_tip.tolist(), "states": states})
    return {"frame": "lps", "lps_from_entry": motions.lps_from_entry.tolist(), "tips": found}


class PublishedTips:
    """The tips in a folder of cases, read when they are first asked for."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._read: dict[tuple[str, str], Any] = {}

    def tip(self, phantom: str, system: str, number: int) -> Mapping[str, Any]:
        """Return `lps_from_entry`, `states` and `lps_from_tip` of a tip.

        Raises:
            FileError: If the file of tips cannot be read.
            SettingsError: If there is no tip of that number.
        """
        path = self._folder / phantom / _tips_file(system)
        if (phantom, system) not in self._read:
            self._read[phantom, system] = read_json(
                path, expected="published tips", remedy="Make the cases with --tips"
            )
        content = self._read[phantom, system]
        try:
            return {"lps_from_entry": content["lps_from_entry"], **content["tips"][number]}
        except (KeyError, IndexError, TypeError) as error:
            raise SettingsError(
                f"{phantom} has no published tip {number} for {system}",
                expected=f"a number of the list `tips` in {path.name}",
                remedy="Name another tip, or state lps_from_entry, states and lps_from_tip",
            ) from error
