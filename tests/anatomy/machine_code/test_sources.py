"""Stamps of kernels follow what they import, and tell every content from every other."""

from __future__ import annotations

import shutil
from pathlib import Path

import grimp
import pytest

import anatomy
from anatomy.machine_code import sources
from anatomy.machine_code.sources import PACKAGES, Sources, kernel_modules

CHECKOUT = Path(anatomy.__file__).parents[1]


def test_a_closure_is_all_that_is_imported() -> None:
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    machine_code = {"anatomy.machine_code"} | graph.find_descendants("anatomy.machine_code")
    for module in kernel_modules():
        used: set[str] = set()
        ahead = {module}
        while ahead:  # Not what `machine_code` imports in its turn.
            used |= ahead
            ahead = {each for at in ahead for each in graph.find_modules_directly_imported_by(at)}
            ahead -= used | machine_code
        closure = Sources().closure(module)
        assert used <= closure, module
        others = {each for each in closure if "kernels" not in each.split(".")}
        assert others <= {"anatomy.base.typed", "anatomy.base.facade"}, (
            f"{module}: no edit of these changes it"
        )


def test_every_module_with_a_compiled_function_is_a_kernel_module() -> None:
    kernels = set(kernel_modules())
    assert {"anatomy.kernels.field", "anatomy.phantom.kernels", "stages.scope.kernels.body"} <= kernels
    assert "anatomy.kernels.compiling" not in kernels
    for package in PACKAGES:
        for file in (CHECKOUT / package).rglob("*.py"):
            name = ".".join(file.relative_to(CHECKOUT).with_suffix("").parts)
            if name != "anatomy.kernels.compiling":
                assert "njit" not in file.read_text(encoding="utf-8"), (
                    f"{name}: use anatomy.kernels.compiling"
                )


@pytest.fixture
def copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a copy of the kernels of anatomy, which stands for the project."""
    shutil.copytree(CHECKOUT / "anatomy" / "kernels", tmp_path / "anatomy" / "kernels")
    (tmp_path / "anatomy" / "__init__.py").touch()
    monkeypatch.setattr(sources, "_roots", lambda package: (tmp_path / package,))
    return tmp_path / "anatomy" / "kernels"


def test_a_stamp_changes_with_what_is_called_and_with_nothing_else(copy: Path) -> None:
    names = ("arcs", "labels", "field", "none")

    def stamps() -> dict[str, str | None]:
        return {name: Sources().stamp(f"anatomy.kernels.{name}") for name in names}

    before = stamps()
    assert before["none"] is None and len(set(before.values())) == 4
    (copy / "labels.py").write_text((copy / "labels.py").read_text() + "\n")
    after = stamps()
    assert after["labels"] != before["labels"] and after["field"] != before["field"], "field uses labels"
    assert after["arcs"] == before["arcs"]


def test_a_stamp_is_that_of_the_content_that_was_imported(copy: Path) -> None:
    """A module that is edited after its import keeps its stamp; one imported after an edit has a new one."""
    known = Sources()
    motion, field = known.stamp("anatomy.kernels.motion"), known.stamp("anatomy.kernels.field")
    for name in ("field", "arcs"):
        (copy / f"{name}.py").write_text((copy / f"{name}.py").read_text() + "\n")
    assert known.stamp("anatomy.kernels.field") == field and known.stamp("anatomy.kernels.motion") == motion
    assert known.stamp("anatomy.kernels.arcs") == Sources().stamp("anatomy.kernels.arcs")


def test_digests_are_of_rooms(copy: Path) -> None:
    def digest(*rooms: str) -> str:
        return sources.kernel_digest.__wrapped__(*rooms)

    before = digest("anatomy"), digest("anatomy.kernels"), digest("anatomy.phantom")
    assert before[0] == before[1] != before[2]
    (copy / "random.py").write_text("# Another one.\n" + (copy / "random.py").read_text())
    assert digest("anatomy") != before[0] and digest("anatomy.phantom") == before[2]
