"""`import lungaccess as la` is all that a user needs."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.errors import FileError, LungaccessError
from anatomy.base.facade import public_names
from anatomy.lung import Lung
from anatomy.phantom import Phantom, write_phantom

FACADES = (
    "anatomy",
    "anatomy.io",
    "anatomy.phantom",
    "anatomy.segmentation",
    "anatomy.tree",
    "lungaccess",
    "lungaccess.judging",
    "lungaccess.judging.appraisal",
    "lungaccess.judging.checking",
    "lungaccess.planning",
    "lungaccess.planning.coupled",
    "lungaccess.planning.one_stage",
    "lungaccess.problem",
    "lungaccess.planning.procedure",
    "lungaccess.planning.reachability",
    "lungaccess.planning.success",
    "lungaccess.uncertainty.risk",
    "lungaccess.running.study",
    "stages.needle",
    "stages.needle.infeasibility.kernels",
    "stages.needle.kernels",
    "stages.scope",
    "stages.scope.advisor",
    "stages.scope.route",
    "stages.scope.tour",
    "stages.tube",
    "stages.tube.kernels",
)


@pytest.mark.parametrize("name", la.__all__)
def test_every_public_name_is_there_and_documented(name: str) -> None:
    value = getattr(la, name)
    assert value.__doc__
    assert value.__name__ == name


def test_names() -> None:
    assert set(la.__all__) <= set(dir(la))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        la.nothing  # noqa: B018


@pytest.mark.parametrize("package", FACADES)
def test_facades_hold_every_name_they_state(package: str) -> None:
    """Each name that a facade states is there, under the same name in its own module."""
    module = import_module(package)
    names = public_names(str(module.__file__))
    assert names
    for name, home in names.items():
        assert getattr(module, name) is getattr(import_module(home), name)
        assert home.startswith(f"{package}.") or package == "lungaccess"


def test_modules_do_not_hide_functions() -> None:
    """`la.plan` and `la.check` stay functions whatever has been imported before."""
    code = (
        "import lungaccess.judging.answering, lungaccess.plans.plan, lungaccess.judging.checking\n"
        "import lungaccess.cli.app, lungaccess as la\n"
        "print(callable(la.plan) and callable(la.check))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True"


def test_errors_have_one_base() -> None:
    assert issubclass(la.NoPlan, la.LungaccessError)
    assert la.LungaccessError is LungaccessError


@pytest.mark.slow
def test_from_files_to_a_checked_plan_and_back(small_phantom: Phantom, tmp_path: Path) -> None:
    """What the documentation shows, on a patient written to disk."""
    write_phantom(small_phantom, tmp_path / "patient")
    steps: list[str] = []
    lung = la.load_patient(tmp_path / "patient", cache=tmp_path / "cache", progress=steps.append)
    assert steps
    system = la.load_system("ultrathin")
    plans = list(la.plan(lung, system, la.resolve_target(lung), iterations=20, goal="default"))
    plans[-1].save(tmp_path / "plan.json")
    stored = la.Plan.load(tmp_path / "plan.json")
    assert stored.digest == plans[-1].digest
    again = la.load_patient(str(tmp_path / "patient"), cache=str(tmp_path / "cache"))
    assert again.key == lung.key
    assert np.array_equal(again.labels, lung.labels)
    report = la.check(stored, again, system, target_lps=la.resolve_target(again).lps_mm)
    assert report.accepted, [f.name for f in report.findings if not f.ok]
    assert json.loads((tmp_path / "plan.json").read_text())["patient_name"] == lung.name


def test_a_folder_that_is_no_patient(tmp_path: Path) -> None:
    with pytest.raises(FileError):
        la.load_patient(tmp_path, cache=tmp_path / "cache")


@pytest.mark.slow
def test_the_patient_in_memory_and_from_files_is_the_same(
    small_phantom: Phantom, small_lung: Lung, tmp_path: Path
) -> None:
    write_phantom(small_phantom, tmp_path / "patient")
    lung = la.load_patient(tmp_path / "patient", cache=tmp_path / "cache")
    assert np.array_equal(lung.labels, small_lung.labels)
    assert np.allclose(lung.grid.lps_from_ijk, small_lung.grid.lps_from_ijk, atol=1e-4)
