"""Fixtures shared by all tests."""

from __future__ import annotations

import gc
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, settings

from stages.needle import has_ompl

if TYPE_CHECKING:
    import lungaccess as la
    from anatomy.lung import Lung
    from anatomy.phantom import Phantom

pytest_plugins = ["tests.compile_times", "tests.tiers"]
_CHECKOUT = Path(__file__).resolve().parents[1]


OMPL_ALONE = _CHECKOUT / "tests" / "stages" / "needle" / "ompl"
"""All tests in this folder need OMPL, as do others with the mark `ompl`."""
WITHOUT_OMPL = "OMPL is not installed, or kept away by --without-ompl"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Let tests be run as on a platform for which OMPL has no wheels."""
    parser.addoption("--without-ompl", action="store_true", help="run the tests as if OMPL were not there")


def pytest_configure(config: pytest.Config) -> None:
    """Put a module that cannot be imported before OMPL, in this process and in those that it starts."""
    if config.getoption("--without-ompl"):
        blocked = str(_CHECKOUT / "tests" / "without_ompl")
        sys.path.insert(0, blocked)
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [blocked, os.environ.get("PYTHONPATH")]))


class _Skipped(pytest.Module):
    """A module of tests that is not even imported."""

    def collect(self) -> list[pytest.Item | pytest.Collector]:
        pytest.skip(WITHOUT_OMPL, allow_module_level=True)


def pytest_pycollect_makemodule(module_path: Path, parent: pytest.Collector) -> pytest.Module | None:
    """Skip what needs OMPL to be imported, where it is missing."""
    if OMPL_ALONE in module_path.parents and not has_ompl():
        return _Skipped.from_parent(parent, path=module_path)
    return None


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip what needs OMPL to run, where it is missing."""
    if item.get_closest_marker("ompl") and not has_ompl():
        pytest.skip(WITHOUT_OMPL)


# No test may depend on the speed of the machine.
settings.register_profile("lungaccess", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("lungaccess")


def pytest_collection_finish() -> None:
    """Spare the garbage collector all that the tests have imported, and most of its short rounds."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000)


def pytest_unconfigure() -> None:
    """Let everything be freed at the exit: OMPL reports what is left as leaks, below the summary."""
    gc.unfreeze()


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Return the folder of real anatomy, or skip the test where there is none."""
    stated = os.environ.get("LUNGACCESS_DATA")
    folder = Path(stated) if stated else _CHECKOUT.parent / "shared" / "data"
    if not folder.is_dir():
        how = "LUNGACCESS_DATA names" if stated else "LUNGACCESS_DATA is not set and the default is"
        pytest.skip(f"no real anatomy: {how} {folder}, which is not a folder")
    return folder


@pytest.fixture(scope="session")
def small_phantom() -> Phantom:
    """Return a synthetic patient with known truth, at a child's size in coarse voxels."""
    from anatomy.phantom import make_phantom

    return make_phantom(seed=3, size="small")


@pytest.fixture(scope="session")
def small_lung(small_phantom: Phantom) -> Lung:
    """Return the lung of `small_phantom`."""
    from anatomy.build import build_lung

    return build_lung(small_phantom.images)


@pytest.fixture(scope="session")
def small_atlas(small_lung: Lung) -> la.Atlas:
    """Return what the preset `ultrathin` can do in `small_lung`."""
    import lungaccess as la

    return la.build_atlas(small_lung, la.load_system("ultrathin"))
