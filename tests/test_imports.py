"""The direction of imports, who may use which library, and what stays out of start-up."""

from __future__ import annotations

import subprocess
import sys
from fnmatch import fnmatch
from pathlib import Path

import grimp
import pytest
from importlinter import cli

from docs.import_graph import core, lines_of, room_of

CHECKOUT = Path(__file__).resolve().parents[1]
OURS = ("anatomy", "stages", "lungaccess")
KERNELS_MAY_USE = {"__future__", "collections", "math", "numba", "numpy", "platform", "typing"}
COMPILED_WITH = ("anatomy.machine_code.cache",)
CHECK_MAY_USE = (
    "anatomy.*",
    "stages.*.device",
    "lungaccess.plans.file",
    "lungaccess.plans.parts",
    "lungaccess.plans.plan",
    "lungaccess.plans.version",
    "lungaccess.problem.goals",
    "lungaccess.problem.system",
    "lungaccess.problem.tools",
    "lungaccess.judging.checking*",
    "stages.tube.casadi_shape",
)
SECOND_OPINION = {
    "stages.tube.casadi_model",
    "stages.tube.casadi_rates",
    "stages.tube.casadi_shape",
    "stages.tube.errors",
    "stages.tube.sequences",
}
"""The mechanics of tubes by CasADi, which nothing else of a planner uses."""
BESIDE_FACADES = ("stages.*.device", "stages.tube.arcs", "stages.tube.casadi_shape")
NOT_AT_START_UP = (
    "SimpleITK", "casadi", "edt", "fcl", "matplotlib", "networkx", "ompl", "pydicom", "skimage", "trimesh",
)  # fmt: skip


@pytest.fixture(scope="module")
def graph() -> grimp.ImportGraph:
    return grimp.build_graph(*OURS, include_external_packages=True, cache_dir=None)


def is_kernel(module: str) -> bool:
    return "kernels" in module.split(".")


def kernel_room(module: str) -> str:
    """Return the kernels module or package that `module` belongs to."""
    return module.partition(".kernels")[0] + ".kernels"


def kernels_may_use(module: str, used: str) -> bool:
    """Say whether kernels use their own room, one around it, anatomy's, or couple the stages."""
    here, there = kernel_room(module).removesuffix(".kernels"), kernel_room(used).removesuffix(".kernels")
    coupling = module.startswith("lungaccess.") and is_kernel(used)
    return coupling or there == "anatomy" or here == there or here.startswith(f"{there}.")


def test_contracts_of_the_design_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(CHECKOUT)
    assert cli.lint_imports(no_cache=True) == cli.EXIT_STATUS_SUCCESS


def test_kernels_use_only_numpy_numba_array_types_and_kernels_below_them(graph: grimp.ImportGraph) -> None:
    kernels = [module for module in graph.modules if is_kernel(module)]
    wrong = [
        (module, used)
        for module in kernels
        for used in graph.find_modules_directly_imported_by(module)
        if used.split(".")[0] not in KERNELS_MAY_USE
        and used not in ("anatomy.base.facade", "anatomy.base.typed", *COMPILED_WITH)
        and not (is_kernel(used) and kernels_may_use(module, used))
    ]
    assert kernels
    assert not wrong


@pytest.mark.parametrize("outside", ["benchmarks", "experiments", "tests"])
def test_what_is_installed_uses_nothing_that_is_not(graph: grimp.ImportGraph, outside: str) -> None:
    assert outside not in graph.modules


def test_check_uses_only_data_types_and_anatomy(graph: grimp.ImportGraph) -> None:
    rooms = {"lungaccess.judging.checking"} | graph.find_descendants("lungaccess.judging.checking")
    used = set().union(*(graph.find_modules_directly_imported_by(module) for module in rooms))
    ours = {module for module in used if module.split(".")[0] in OURS}
    assert ours
    assert not {module for module in ours if not any(fnmatch(module, may) for may in CHECK_MAY_USE)}
    assert not {module for module in ours if is_kernel(module)}


def test_the_product_uses_the_stages_through_their_facades(graph: grimp.ImportGraph) -> None:
    """What the check reaches takes devices and what shares nothing with planners, so it meets no facade."""
    packages = {m for m in graph.modules if m.startswith("stages") and graph.find_children(m)}
    reached = graph.find_upstream_modules("lungaccess.judging.checking", as_package=True)
    reached |= {"lungaccess.judging.checking"} | graph.find_descendants("lungaccess.judging.checking")
    wrong = [
        (module, used)
        for module in graph.find_descendants("lungaccess")
        for used in graph.find_modules_directly_imported_by(module)
        if used.startswith("stages.") and used not in packages
        if module not in reached or not any(fnmatch(used, may) for may in BESIDE_FACADES)
    ]
    assert not wrong


def test_no_modules_of_the_product_import_each_other_in_a_circle(graph: grimp.ImportGraph) -> None:
    modules = {module for module in graph.modules if module.split(".")[0] in OURS}
    while True:
        inner = {m for m in modules if graph.find_modules_directly_imported_by(m) & modules}
        inner = {m for m in inner if graph.find_modules_that_directly_import(m) & modules}
        if inner == modules:
            break
        modules = inner
    assert not modules


def test_nothing_that_check_uses_leads_to_a_planner(graph: grimp.ImportGraph) -> None:
    reached = graph.find_upstream_modules("lungaccess.judging.checking", as_package=True)
    stages = {module for module in reached if module.startswith("stages.")}
    assert stages
    settings = {module for module in stages if fnmatch(module, "stages.*.device")}
    assert not stages - settings - SECOND_OPINION - {"stages.tube.device", "stages.tube.arcs"}


@pytest.mark.parametrize("statement", ["import lungaccess", "import lungaccess.problem.system"])
def test_heavy_libraries_are_imported_only_where_they_are_used(statement: str) -> None:
    script = f"{statement}\nimport sys\nprint(' '.join(set(sys.modules) & set({NOT_AT_START_UP!r})))"
    loaded = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)
    assert loaded.stdout.split() == []


def test_the_core_knows_no_guides_pictures_or_runs() -> None:
    """Plans and their check need no segmentation and phantoms, and nothing that guides, shows or repeats."""
    plugged_in = {
        "anatomy.segmentation", "anatomy.phantom", "stages.scope.advisor", "stages.scope.route",
        "stages.scope.tour", "lungaccess.showing", "lungaccess.running", "lungaccess.cli",
    }  # fmt: skip
    assert "lungaccess.planning.coupled.atlas" in core() and "stages.tube.casadi_shape" in core()
    assert {module for module in core() if room_of(module) in plugged_in} == set()
    assert lines_of(core()) <= 55_400
