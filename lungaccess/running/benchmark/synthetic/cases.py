"""The cases of `synthetic-v1` as files: masks, targets, devices and scope tips, for planners in any language.

```
FOLDER/benchmark.json              version, rules, phantoms, hash of the manifest
FOLDER/devices/NAME.toml, .json    the three devices
FOLDER/adult-01/patient.toml ...   a patient of every phantom, as `lungaccess phantom` writes it, without a CT
FOLDER/adult-01/case.json          its queries: name, device, target
FOLDER/adult-01/tips-NAME.json     for each device, where a scope can stand, with the motion that leads there
```

`benchmark.json` is written last, so that a folder that has it is complete.

Scope tips of a case: where a scope can stand, with the motion that leads there.

They let a planner start from a bronchoscope without having one of its own.  A submission names one by number.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from anatomy.base.errors import FileError, SettingsError
from anatomy.base.files import read_json, require_writable_folder, write_json, write_text
from anatomy.base.records import frozen_value
from anatomy.base.settings import to_mapping
from anatomy.lung import Lung
from anatomy.phantom import write_phantom
from lungaccess.planning.coupled.atlas import motions_of
from lungaccess.problem.system import load_system, preset_text
from lungaccess.running.benchmark.synthetic.manifest import (
    Point,
    entries,
    make_benchmark_phantom,
    manifest_sha256,
)
from lungaccess.running.benchmark.synthetic.phantoms import (
    SYSTEMS,
    VERSION,
    BenchmarkPhantom,
    benchmark_phantoms,
    phantom_named,
)

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


def queries_of(case: BenchmarkPhantom) -> Iterator[BenchmarkQuery]:
    """Yield the queries of a phantom, device by device."""
    for system in SYSTEMS:
        for number, point in enumerate(entries()[case.name].targets_lps, start=1):
            name = f"{case.name}/{system}/{number:02d}"
            yield BenchmarkQuery(name=name, phantom=case.name, system=system, target=number, target_lps=point)


def all_queries() -> dict[str, BenchmarkQuery]:
    """Return all queries by name."""
    return {query.name: query for case in benchmark_phantoms() for query in queries_of(case)}


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
    require_writable_folder(folder)
    _write_devices(folder / "devices")
    for number, case in enumerate(cases):
        say(f"making {case.name}", number / len(cases))
        home = folder / case.name
        if not (home / CASE).is_file():
            _write_case(case, home, with_ct=with_ct, with_tips=with_tips)
    present = [case.name for case in benchmark_phantoms() if (folder / case.name / CASE).is_file()]
    about = {"benchmark": VERSION, "manifest_sha256": manifest_sha256(), "rules": list(RULES)}
    write_json(folder / BENCHMARK, {**about, "devices": list(SYSTEMS), "phantoms": present})
    return cases


def _write_devices(folder: Path) -> None:
    require_writable_folder(folder)
    for name in SYSTEMS:
        write_text(folder / f"{name}.toml", preset_text(name))
        write_json(folder / f"{name}.json", to_mapping(load_system(name)))


def _write_case(case: BenchmarkPhantom, home: Path, *, with_ct: bool, with_tips: bool) -> None:
    from anatomy.build import build_lung
    from anatomy.io.patients import load_patient

    made = make_benchmark_phantom(case)
    write_phantom(made, home, breathing=case.breathes, with_ct=with_ct)
    if with_tips:
        lung = build_lung(load_patient(home))
        for name in SYSTEMS:
            write_json(home / tips_file(name), scope_tips(lung, name))
    queries = [
        {"name": query.name, "device": query.system, "target_lps": list(query.target_lps)}
        for query in queries_of(case)
    ]
    about = {"benchmark": VERSION, "phantom": case.name, "family": case.family, "seed": case.seed}
    hashed = {"masks_sha256": entries()[case.name].masks_sha256, "traits": asdict(case.traits)}
    write_json(home / CASE, {**about, **hashed, "queries": queries})


def require_cases(folder: Path) -> tuple[BenchmarkPhantom, ...]:
    """Return the phantoms that a folder holds.

    Raises:
        FileError: If it is no folder of this benchmark, or of one with other phantoms.
    """
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


def tips_file(system: str) -> str:
    """Return the name of the file of tips of a device, in the folder of a phantom."""
    return f"tips-{system}.json"


def scope_tips(lung: Lung, system: str) -> dict[str, Any]:
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
        path = self._folder / phantom / tips_file(system)
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
