"""What a release consists of agrees with itself: matrix, constraints, recipe, container, citation, pages."""

from __future__ import annotations

import importlib.util
import re
import tomllib
from pathlib import Path
from types import ModuleType

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CONTAINER = (ROOT / "packaging/Containerfile").read_text()
CONDA_NAMES = {"matplotlib": "matplotlib-base"}
RUN_EXTRAS = ("learned", "live", "study", "view")


def load(name: str) -> ModuleType:
    """Return a script of the folder `packaging`."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "packaging" / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


release, publish_docs, resolve = load("release"), load("publish_docs"), load("resolve")


def bounds(*extras: str) -> dict[str, str]:
    """Return the lower bounds of pyproject.toml by name in small letters."""
    stated = [*PROJECT["dependencies"]]
    for extra in extras:
        stated += PROJECT["optional-dependencies"][extra]
    return {name.lower(): bound for name, bound in (each.split(";")[0].split(">=") for each in stated)}


def pins(file: str) -> dict[str, str]:
    lines = [line for line in (ROOT / file).read_text().splitlines() if not line.startswith("#")]
    return {name.lower(): version for name, version in (line.split("==") for line in lines)}


def same_version(one: str, two: str) -> bool:
    """Say whether two versions are the same one, whatever zeros they end with."""
    return re.sub(r"(\.0)+$", "", one) == re.sub(r"(\.0)+$", "", two)


def test_the_matrix_has_every_version_of_python_that_the_project_states() -> None:
    low, high = re.fullmatch(r">=3\.(\d+),<3\.(\d+)", PROJECT["requires-python"]).groups()  # type: ignore[union-attr]
    stated = [f"3.{minor}" for minor in range(int(low), int(high))]
    classified = [each.rsplit(" ", 1)[1] for each in PROJECT["classifiers"] if ":: 3." in each]
    tried = {each["python"] for each in release.MATRIX["environment"]}
    assert sorted(tried) == stated == classified
    assert all(set(each["python"]) <= set(stated) for each in release.MATRIX["platform"])
    assert set().union(*(each["python"] for each in release.MATRIX["platform"])) == set(stated)
    extremes = {each["dependencies"] for each in release.MATRIX["environment"]}
    assert extremes == {"lowest", "tested", "newest"} == set(release.MATRIX["constraints"])
    assert {"python": stated[0], "dependencies": "lowest"} in release.MATRIX["environment"]
    assert all((ROOT / place).exists() for place in release.MATRIX["tests"]["places"])


def test_the_lowest_constraints_are_the_lower_bounds() -> None:
    lowest = pins("constraints-lowest.txt")
    for name, bound in bounds(*RUN_EXTRAS).items():
        assert same_version(lowest[name], bound), (
            f"{name}>={bound}, constraints-lowest.txt has {lowest[name]}"
        )


def test_the_tested_versions_keep_the_bounds() -> None:
    tested = pins("constraints.txt")
    for name, bound in bounds(*RUN_EXTRAS).items():
        numbers = [[int(part) for part in re.findall(r"\d+", text)] for text in (tested[name], bound)]
        assert numbers[0] >= numbers[1], name


def test_the_recipe_has_the_requirements_of_the_project() -> None:
    recipe = yaml.safe_load((ROOT / "packaging/conda/recipe.yaml").read_text())
    run = dict(each.split(" ", 1) for each in recipe["requirements"]["run"])
    assert run.pop("python") == PROJECT["requires-python"]
    assert run == {CONDA_NAMES.get(name, name): f">={bound}" for name, bound in bounds().items()}
    assert recipe["package"]["version"] == PROJECT["version"]
    command = recipe["build"]["python"]["entry_points"]
    assert command == [f"{name} = {place}" for name, place in PROJECT["scripts"].items()]


def test_the_container_installs_the_tested_versions_by_their_digests() -> None:
    text = (ROOT / "packaging/requirements.txt").read_text()
    digests = re.findall(
        r"^([\w.-]+)==(\S+).*?((?:\\\n    --hash=sha256:[0-9a-f]{64} ?)+)$", text, re.MULTILINE
    )
    assert len(digests) == len(re.findall(r"^\w", text, re.MULTILINE)) and "--require-hashes" in CONTAINER
    tested = {name.replace("_", "-"): version for name, version in pins("constraints.txt").items()}
    held = {name: version for name, version, _files in digests}
    assert held == {name: tested.get(name) for name in held}
    assert set(bounds("live", "study", "view")) <= set(held)


def test_the_container_copies_what_is_there() -> None:
    copied = [
        words
        for line in re.findall(r"^COPY (?!--from)(.+) \S+$", CONTAINER, re.MULTILINE)
        for words in line.split()
    ]
    assert copied and all((ROOT / name).exists() for name in copied)
    for package in release.PACKAGES:
        assert package in copied
    versions = set(re.findall(r"^FROM python:(3\.\d+)", CONTAINER, re.MULTILINE))
    tested = {each["python"] for each in release.MATRIX["environment"] if each["dependencies"] == "tested"}
    assert versions == tested


def test_the_workflow_takes_its_environments_from_the_matrix() -> None:
    text = (ROOT / ".github/workflows/release.yml").read_text()
    jobs = yaml.safe_load(text)["jobs"]
    assert "release.py matrix" in jobs["matrix"]["steps"][-1]["run"]
    assert "fromJSON(needs.matrix.outputs" in jobs["try"]["strategy"]["matrix"]
    assert not re.findall(r"3\.1[134]", text)


def test_the_citation_is_that_of_this_version_without_placeholders() -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert cited["cff-version"] == "1.2.0"
    assert cited["version"] == PROJECT["version"]
    assert cited["license"] == PROJECT["license"]
    assert cited["authors"] == PROJECT["authors"]
    assert not re.search("orcid|doi|TODO|0000-", (ROOT / "CITATION.cff").read_text(), re.IGNORECASE)
    assert f"({PROJECT['version']})" in (ROOT / "CHANGELOG.md").read_text()


def test_contents_that_differ_are_named() -> None:
    release.require_same({"a": 1}, {"a": 1}, "wheel", "tree")
    with pytest.raises(release.ReleaseError, match="wheel alone has c\ntree alone has b\na differs"):
        release.require_same({"a": 1, "c": 0}, {"a": 2, "b": 0}, "wheel", "tree")


def test_what_an_sdist_holds_beside_the_packages_is_in_git() -> None:
    assert set(release.tracked()) >= release.BESIDE


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """Return a built documentation of version 0.9.0."""
    folder = tmp_path / "site"
    folder.mkdir()
    (folder / "index.html").write_text('pages of 0.9.0 <div id="versions">Version 0.9.0</div>')
    (folder / "how_to").mkdir()
    (folder / "how_to/old.html").write_text('<div id="versions">Version 0.9.0</div>')
    (folder / "version.txt").write_text("0.9.0\n")
    return folder


def test_versions_lie_side_by_side_newest_first(site: Path, tmp_path: Path) -> None:
    published = tmp_path / "published"
    publish_docs.publish(site, published)
    (site / "version.txt").write_text("0.10.0\n")
    assert publish_docs.publish(site, published) == ["0.10.0", "0.9.0"]
    (site / "index.html").write_text("better pages")
    (site / "how_to/old.html").unlink()
    publish_docs.publish(site, published)
    assert (published / "0.10.0/index.html").read_text() == "better pages"
    assert '0.9.0 <a href="../0.10.0/index.html">0.10.0</a>' in (published / "0.9.0/index.html").read_text()
    # The newer version has no such page: its first page is there in its place.
    assert '<a href="../../0.10.0/index.html">' in (published / "0.9.0/how_to/old.html").read_text()
    assert "0.10.0/index.html" in (published / "index.html").read_text()
    assert not [each for each in published.iterdir() if each.name.startswith(".")]


@pytest.mark.parametrize("version", [None, "", "../other", "unknown"])
def test_what_is_no_documentation_is_not_published(site: Path, tmp_path: Path, version: str | None) -> None:
    (site / "version.txt").unlink() if version is None else (site / "version.txt").write_text(version)
    with pytest.raises(publish_docs.PublishError, match="make docs"):
        publish_docs.publish(site, tmp_path / "published")
    assert not (tmp_path / "published").exists()


def test_the_paper_cites_what_its_bibliography_has_and_links_lead_somewhere() -> None:
    text = (ROOT / "paper/paper.md").read_text()
    keys = set(re.findall(r"@\w+\{(\w+),", (ROOT / "paper/paper.bib").read_text()))
    cited = set(re.findall(r"(?<![\w.])@(\w+)", text))
    assert cited == keys
    links = [link for link in re.findall(r"\]\(([^)#]+)", text) if not link.startswith("http")]
    assert links and all((ROOT / "paper" / link).exists() for link in links)
    for section in ("Summary", "Statement of need", "State of the field", "Figures"):
        assert f"# {section}\n" in text


def test_ompl_is_required_where_it_has_wheels_alone() -> None:
    required = {
        (platform["name"], python)
        for platform in release.MATRIX["platform"]
        for python in platform["python"]
        if any(
            line.startswith("ompl")
            for line in resolve.applying(PROJECT["dependencies"], resolve.environment(platform, python))
        )
    }
    having = ("Linux x86-64", "macOS 15 arm64", "macOS 15 x86-64")
    assert required == {(name, python) for name in having for python in ("3.11", "3.12", "3.13")}


def test_indirect_requirements_of_another_platform_are_resolved_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """A library that a requirement needs on Windows alone is asked for there; what pip refuses is told."""
    asked: list[list[str]] = []

    def pip(wanted: list[str], _tags: list[str], _python: str) -> tuple[list[object] | None, str]:
        asked.append(wanted)
        if any(line.startswith("nowhere") for line in wanted):
            return None, "No matching distribution found for nowhere"
        needs = ["colorama; sys_platform == 'win32'", "nowhere; sys_platform == 'darwin'"]
        names = [re.split("[<>=]", line)[0] for line in wanted]
        return [{"metadata": {"name": name, "requires_dist": needs}} for name in names], ""

    monkeypatch.setattr(resolve, "pip_report", pip)
    windows, mac = (
        next(p for p in release.MATRIX["platform"] if name in p["name"]) for name in ("Win", "mac")
    )
    assert resolve.resolve(windows, "3.12") == "" and "colorama" in asked[-1]
    assert "nowhere" in resolve.resolve(mac, "3.12")
    told = resolve.table({("Windows", "3.12"): "", ("macOS", "3.12"): "no wheel"})
    assert "| macOS | NO |" in told and told.endswith("macOS, Python 3.12: no wheel")


def test_without_a_registry_nothing_fails(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(resolve, "pip_report", lambda *_: (None, "no connection"))
    monkeypatch.setattr("sys.argv", ["resolve.py"])
    assert resolve.main() == 0 and "No package registry" in capsys.readouterr().out
