"""Plans of the small phantom and the page of them, made once for all tests of this folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import lungaccess as la
from anatomy.lung import Lung
from lungaccess.plans.plan import Plan
from tests.lungaccess.showing.report import browser
from tests.lungaccess.showing.report.pages import make_plans, plan_file, report_data, with_stated_window


@pytest.fixture(scope="session")
def plans(small_lung: Lung, small_atlas: la.Atlas) -> tuple[Plan, ...]:
    return make_plans(small_lung, small_atlas)


@pytest.fixture(scope="session")
def page(plans: tuple[Plan, ...], small_lung: Lung, small_phantom: Any, tmp_path_factory: Any) -> Path:
    return plan_file(plans, small_lung, small_phantom.ct, tmp_path_factory.mktemp("page"))


@pytest.fixture(scope="session")
def data(page: Path) -> dict[str, Any]:
    return report_data(page)


@pytest.fixture(scope="session")
def breathing_plans(plans: tuple[Plan, ...], breathing_lung: Lung) -> tuple[Plan, ...]:
    """Those plans with a window that is stated, not computed."""
    return tuple(with_stated_window(each, breathing_lung) for each in plans)


@pytest.fixture(scope="session")
def breathing_page(breathing_plans: tuple[Plan, ...], breathing_lung: Lung, tmp_path_factory: Any) -> Path:
    """A page that breathes, in the phase of the masks at first."""
    return plan_file(breathing_plans, breathing_lung, None, tmp_path_factory.mktemp("browser"))


@pytest.fixture(scope="session")
def breathing_window(breathing_page: Path) -> Iterator[browser.Browser]:
    """A window with that page; each test leaves it as it was."""
    with browser.Browser(1000, 700) as window:
        window.open(breathing_page)
        yield window
