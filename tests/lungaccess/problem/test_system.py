"""Presets and device files: what fits, what is refused, and that equal systems have equal fingerprints."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from anatomy.base.errors import FileError, SettingsError
from anatomy.base.settings import override, parse, to_mapping
from docs.write_tables import device_keys
from lungaccess.problem.channel import needle_load, system_warnings
from lungaccess.problem.system import (
    System,
    load_system,
    needle_preset_names,
    preset_names,
    preset_text,
    shipped_names,
    system_fingerprint,
    tube_preset_names,
)

DOCS = Path(__file__).resolve().parents[3] / "docs"
DEFAULT = preset_text("thin-scope")


def write(folder: Path, content: str) -> Path:
    path = folder / "device.toml"
    path.write_text(content, encoding="utf-8")
    return path


def test_presets_ship_with_the_package() -> None:
    assert preset_names() == (
        "flexure-needle",
        "lung-default",
        "stylet-needle",
        "therapeutic-scope",
        "thin-scope",
        "tubes-only",
        "ultrathin",
    )
    assert needle_preset_names() == ("med-rad-needle",)
    assert tube_preset_names() == ("curved-outer",)


@pytest.mark.parametrize("name", shipped_names())
def test_preset_is_valid_sourced_and_survives_a_round_trip(name: str) -> None:
    system = load_system(name)
    assert system.name == name
    assert system.description
    assert any("assumption" in source for source in system.sources)
    assert parse(System, to_mapping(system), name) == system


@pytest.mark.parametrize("name", shipped_names())
def test_sources_of_presets_are_in_the_bibliography(name: str) -> None:
    bibliography = (DOCS / "reference" / "bibliography.md").read_text(encoding="utf-8")
    keys = {part.split("]")[0] for source in load_system(name).sources for part in source.split("[")[1:]}
    assert keys
    assert not {key for key in keys if f"[{key}]" not in bibliography}


def test_the_published_needle_keeps_a_millimetre_and_bends_as_published() -> None:
    system = load_system("med-rad-needle")
    assert system.needle.radius_mm + system.margins.total_mm == 1.0
    assert system.needle.min_radius_of_curvature_mm == pytest.approx(121.0, rel=1e-15)


def test_needle_radii_of_presets() -> None:
    assert load_system("thin-scope").needle.min_radius_of_curvature_mm == pytest.approx(121.0, rel=1e-15)
    assert load_system("flexure-needle").needle.min_radius_of_curvature_mm == 50.0


def test_needle_and_margins_keep_one_millimetre_in_all() -> None:
    system = load_system("thin-scope")
    assert system.needle.radius_mm + system.margins.total_mm == 1.0


def test_presets_differ_in_what_they_are_named_for() -> None:
    middle, large, thin = map(load_system, ("thin-scope", "therapeutic-scope", "ultrathin"))
    assert thin.scope.outer_diameter_mm < middle.scope.outer_diameter_mm < large.scope.outer_diameter_mm
    assert (thin.scope.channel_diameter_mm, large.scope.channel_diameter_mm) == (1.7, 2.8)


def test_file_and_preset_give_the_same_system(tmp_path: Path) -> None:
    path = write(tmp_path, DEFAULT)
    assert load_system(path) == load_system(str(path)) == load_system("thin-scope")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[needle]\ndiameter_mm = 1.0", "[needle]\ndiameter_mm = nan", r"needle\.diameter_mm = nan"),
        ("[needle]\ndiameter_mm = 1.0", "[needle]\ndiameter_mm = -1.0", r"needle\.diameter_mm = -1\.0"),
        ("[needle]\ndiameter_mm = 1.0", "[needle]\ndiameter_mm = 1.3", r"needle\.diameter_mm = 1\.3"),
        ("[needle]\ndiameter_mm = 1.0", "[needle]\ndiameter_mm = '1'", r"needle\.diameter_mm = '1'"),
        ("[needle]\ndiameter_mm = 1.0", "[needle]\nwidth_mm = 1.0", r"needle\.width_mm is not a setting"),
        ("max_length_mm = 150.0", "max_length_mm = inf", r"needle\.max_length_mm = inf"),
        ("channel_diameter_mm = 2.0", "channel_diameter_mm = 1.9", r"tubes\.outer\.outer_diameter_mm = 1\.9"),
        ("channel_diameter_mm = 2.0", "channel_diameter_mm = 5.0", r"scope\.channel_diameter_mm = 5\.0"),
        ("max_strain = 0.08\n", "max_strain = 0.01\n", r"tubes\.inner\.precurvature_per_mm = 0\.025"),
        ("segmentation_margin_mm = 0.5", "segmentation_margin_mm = -0.5", "segmentation_margin_mm = -0.5"),
        ("[margins]", "[margin]", "margin is not a setting"),
        ("[needle]", "fissures_allowed = 'no'\n[needle]", "fissures_allowed"),
        ("[needle]", "[needle", "not valid TOML"),
        ("diameter_mm = 1.0\n", "diameter_mm = 1.0\ndiameter_mm = 2.0\n", "not valid TOML"),
    ],
)
def test_bad_device_files_are_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert DEFAULT.count(old) == 1
    path = write(tmp_path, DEFAULT.replace(old, new))
    with pytest.raises(SettingsError, match=message) as caught:
        load_system(path)
    assert str(path) in caught.value.found


def test_file_that_is_not_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "device.toml"
    path.write_bytes(b"name = '\xff\xfe'")
    with pytest.raises(FileError, match="no text in UTF-8: byte 8"):
        load_system(path)


def test_unknown_names_list_the_presets() -> None:
    with pytest.raises(SettingsError, match="no system called 'lung'") as caught:
        load_system("lung")
    assert "thin-scope" in caught.value.expected


def test_missing_file_is_a_file_error(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="There is no file"):
        load_system(tmp_path / "absent.toml")
    with pytest.raises(FileError, match="There is no file"):
        load_system(str(tmp_path / "absent.toml"))


def test_fingerprint_depends_on_every_number_and_nothing_else() -> None:
    system = load_system("thin-scope")
    assert system_fingerprint(system) == system_fingerprint(parse(System, to_mapping(system), ""))
    assert len(system_fingerprint(system)) == 64
    finer = math.nextafter(system.needle.diameter_mm, 0.0)
    changed = (
        override(system, {"needle.diameter_mm": finer}),
        override(system, {"margins.registration_margin_mm": 0.1}),
        replace(system, fissures_allowed=True),
    )
    assert len({system_fingerprint(other) for other in (system, *changed)}) == 4


def test_a_needle_without_further_keys_is_a_solid_wire_of_nitinol() -> None:
    stated = to_mapping(load_system("lung-default"))
    needle = {key: stated["needle"][key] for key in ("diameter_mm", "max_curvature_per_mm", "max_length_mm")}
    system = parse(System, {**stated, "name": "bare", "needle_preloaded": False, "needle": needle}, "bare")
    assert system.needle_tube.bending_stiffness_n_mm2 == pytest.approx(60e3 * math.pi / 64.0 * 0.8**4)
    assert system.needle_tube.length_mm == system.tubes.inner.length_mm + system.needle.max_length_mm
    assert not system.needle_tube.bends


def test_a_needle_states_its_shaft_as_tubes_do_and_may_be_neglected() -> None:
    slots = {"length_mm": 900.0, "stiffness_factor": 0.04, "strain_factor": 0.75}
    changes = {"needle.inner_diameter_mm": 0.6, "needle.slotted_segments": [slots]}
    shaft = override(load_system("lung-default"), {"name": "other", **changes}).needle_tube
    plain = 60e3 * math.pi / 64.0 * (0.8**4 - 0.6**4)
    assert shaft.parts.stiffness_n_mm2 == pytest.approx([0.04 * plain])
    assert shaft.length_mm == 900.0
    changes = {"name": "other", "needle.youngs_modulus_gpa": 0.0}
    assert override(load_system("lung-default"), changes).needle_tube is None
    assert load_system("tubes-only").needle_tube is None


def test_a_system_warns_of_a_needle_that_bends_its_tubes_away() -> None:
    solid = {"needle.slotted_segments": (), "needle.inner_diameter_mm": 0.0}
    system = override(load_system("lung-default"), {"name": "other", "needle_preloaded": False, **solid})
    load = needle_load(system)
    inner, kappa = 0.04 * system.tubes.inner.bending_stiffness_n_mm2, system.tubes.inner.precurvature_per_mm
    ratio = system.needle_tube.bending_stiffness_n_mm2 / inner
    assert load.ratio == pytest.approx(ratio)
    assert load.out_mm == 40.0
    left = 40.0 * kappa / (1.0 + ratio)
    assert math.radians(load.turn_deg) == pytest.approx(40.0 * kappa - left)
    tips = [40.0 / turn * np.array([1.0 - math.cos(turn), math.sin(turn)]) for turn in (40.0 * kappa, left)]
    assert load.shift_mm == pytest.approx(np.linalg.norm(tips[1] - tips[0]), abs=1e-5)
    assert system_warnings(system) == (load.words,)
    for name in (*preset_names(), *tube_preset_names()):
        assert not system_warnings(load_system(name))
    assert not system_warnings(replace(system, needle_preloaded=True))
    assert not system_warnings(override(system, {"needle.youngs_modulus_gpa": 0.0}))


def test_example_of_the_documentation_works(tmp_path: Path) -> None:
    page = (DOCS / "how_to" / "devices.md").read_text(encoding="utf-8")
    shown = page.split("```{literalinclude} ")[1].split("\n")[0]
    example = (DOCS / "how_to" / shown).read_text(encoding="utf-8")
    system = load_system(write(tmp_path, example))
    assert system.needle.min_radius_of_curvature_mm == pytest.approx(50.0)


def test_documentation_names_every_key() -> None:
    page = device_keys()

    def keys(mapping: dict[str, object]) -> set[str]:
        nested = (keys(value) for value in mapping.values() if isinstance(value, dict))
        return set(mapping).union(*nested)

    assert not {key for key in keys(to_mapping(load_system("thin-scope"))) if f"`{key}`" not in page}


def test_a_needle_that_lies_in_the_tubes_while_they_are_deployed_belongs_to_them() -> None:
    """The tubes know its shaft, files state it once, and systems of the time before have none."""
    segment = {"length_mm": 250.0, "stiffness_factor": 0.04, "strain_factor": 0.75}
    changes = {"name": "own", "needle_preloaded": True, "needle.slotted_segments": (segment,)}
    plain = override(
        load_system("lung-default"), {"name": "own", "needle_preloaded": False, "needle.slotted_segments": ()}
    )
    system = override(plain, changes)
    assert system.tubes.needle_shaft == system.needle_tube
    assert plain.tubes.needle_shaft is None
    assert system.tubes != plain.tubes
    assert to_mapping(system)["tubes"] == to_mapping(plain)["tubes"]
    assert "needle_preloaded" not in to_mapping(plain)
    assert parse(System, to_mapping(system), "again") == system
    assert replace(system, needle_preloaded=False).tubes.needle_shaft is None
    with pytest.raises(SettingsError, match="needle_shaft is not a setting"):
        override(plain, {"tubes.needle_shaft": None})


def test_what_slides_through_bent_tubes_must_be_alike() -> None:
    system = override(load_system("lung-default"), {"name": "own"})
    assert system.needle_preloaded
    curved_mm, most_mm = system.tubes.inner.curved_length_mm, system.needle.max_length_mm
    segment = {"length_mm": curved_mm + most_mm, "stiffness_factor": 0.1, "strain_factor": 0.75}
    override(system, {"needle.slotted_segments": (segment,)})
    with pytest.raises(SettingsError, match=f"at least {curved_mm + most_mm:g} mm"):
        override(system, {"needle.slotted_segments": ({**segment, "length_mm": 150.0},)})
