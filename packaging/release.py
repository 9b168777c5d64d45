"""Build a release and try it: `make dist`, `make try`.

    python packaging/release.py dist       wheel and sdist in dist/, with their contents checked, and the
                                           wheel of compiled kernels for this platform
    python packaging/release.py try        the wheel in every environment of matrix.toml at hand
    python packaging/release.py try --python 3.12 --dependencies newest
    python packaging/release.py matrix     the environments as one line of JSON

A release is built from a copy of the files that git lists, so that nothing else gets into it.  An environment
is made from nothing; there the first tasks of tests/first_contact are done outside the checkout with the
wheel, and a fast part of the tests is run in a copy of the checkout without the packages, so that the wheel
is what they test.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tomllib
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
MATRIX = tomllib.loads((ROOT / "packaging" / "matrix.toml").read_text(encoding="utf-8"))
PACKAGES = ("anatomy", "stages", "lungaccess")
BESIDE = {
    "CHANGELOG.md", "CITATION.cff", "LICENSE", "MANIFEST.in", "README.md", "constraints.txt",
    "constraints-lowest.txt", "pyproject.toml",
}  # fmt: skip
"""What an sdist holds beside the packages."""
GENERATED = {"PKG-INFO", "setup.cfg"}
"""What setuptools adds to an sdist, apart from the folder lungaccess.egg-info."""
NOT_AT_HAND = 3
"""Exit code of `try` where the version of Python that was asked for is not on this machine."""


class ReleaseError(Exception):
    """A release that must not be published."""


def tracked() -> list[str]:
    """Return the files that git lists, as they are in the working folder."""
    said = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT, check=True, capture_output=True, text=True,
    ).stdout  # fmt: skip
    return [name for name in said.split("\0") if name and (ROOT / name).is_file()]


def copy_of(names: Iterable[str], tree: Path) -> None:
    """Copy files of the checkout into a folder, which is made."""
    for name in names:
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, tree / name)


def build(out: Path) -> tuple[Path, Path]:
    """Build wheel and sdist from the files of git, and the wheel once more from the sdist.

    Raises:
        ReleaseError: If the contents are not those of the packages, the two wheels differ, or the wheel is
            too large.
    """
    names = tracked()
    with tempfile.TemporaryDirectory() as temporary:
        tree, direct = Path(temporary, "tree"), Path(temporary, "direct")
        copy_of(names, tree)
        python = [sys.executable, "-m", "build", "--outdir"]
        subprocess.run([*python, str(out), str(tree)], check=True, stdout=subprocess.DEVNULL)
        subprocess.run([*python, str(direct), "--wheel", str(tree)], check=True, stdout=subprocess.DEVNULL)
        (again,) = direct.glob("*.whl")
        wheel, sdist = out / again.name, out / f"lungaccess-{again.name.split('-')[1]}.tar.gz"
        pack_closely(wheel)
        require_same(members(wheel), members(again), "the wheel of the sdist", "the wheel of the tree")
    ours = {name for name in names if name.split("/")[0] in PACKAGES}
    in_wheel = {name for name in members(wheel) if ".dist-info/" not in name}
    require_same(in_wheel, ours, "the wheel", "the packages in git")
    require_same(contents_of_sdist(sdist), ours | BESIDE, "the sdist", "packages and MANIFEST.in")
    size_mb, limit_mb = wheel.stat().st_size / 1e6, MATRIX["limits"]["wheel_mb"]
    if size_mb > limit_mb:
        raise ReleaseError(
            f"The wheel has {size_mb:.2f} MB, at most {limit_mb} are allowed (packaging/matrix.toml)"
        )
    print(f"{wheel.name}: {size_mb:.2f} MB, {len(ours)} files; the sdist builds the same wheel")
    return wheel, sdist


def pack_closely(wheel: Path) -> None:
    """Pack a wheel once more, as closely as the method allows; the tool that builds it packs for speed."""
    with zipfile.ZipFile(wheel) as loose:
        contents = [(each, loose.read(each)) for each in loose.infolist()]
    with zipfile.ZipFile(wheel, "w") as close:
        for each, data in contents:
            close.writestr(each, data, zipfile.ZIP_DEFLATED, 9)


def members(wheel: Path) -> dict[str, int]:
    """Return the names in a wheel with the checksums of what they hold."""
    with zipfile.ZipFile(wheel) as archive:
        return {each.filename: each.CRC for each in archive.infolist()}


def contents_of_sdist(sdist: Path) -> set[str]:
    """Return the files of an sdist without those that setuptools generates."""
    with tarfile.open(sdist) as archive:
        names = {each.name.partition("/")[2] for each in archive.getmembers() if each.isfile()}
    return {name for name in names - GENERATED if not name.startswith("lungaccess.egg-info/")}


def require_same(found: Any, expected: Any, what: str, where: str) -> None:
    """Raise a ReleaseError that names what is in one of two sets or mappings alone, or differs."""
    if found == expected:
        return
    lines = [f"{what} alone has {name}" for name in sorted(set(found) - set(expected))]
    lines += [f"{where} alone has {name}" for name in sorted(set(expected) - set(found))]
    if isinstance(found, dict):
        both = sorted(found.keys() & expected)
        lines += [f"{name} differs" for name in both if found[name] != expected[name]]
    raise ReleaseError("\n".join([f"{what} is not like {where}:", *lines]))


def python_at_hand(version: str) -> str | None:
    """Return the command of a version of Python, or None where it is not on this machine."""
    command = shutil.which(f"python{version}")
    # A shim of a version manager may stand for a version that is not switched on.
    works = command and subprocess.run([command, "-c", ""], capture_output=True).returncode == 0
    return command if works else None


def try_wheel(wheel: Path, environment: dict[str, str]) -> bool:
    """Say whether a wheel in a new environment does the first tasks and passes the fast tests."""
    version, dependencies = environment["python"], environment["dependencies"]
    python = python_at_hand(version)
    assert python is not None, "only environments at hand are tried"
    with tempfile.TemporaryDirectory() as temporary:
        place = Path(temporary, "place")
        words = [
            sys.executable, str(ROOT / "tests/first_contact/run.py"), "--fresh", "--first",
            "--keep", str(place), "--wheel", str(wheel), "--python", python,
            "--constraints", MATRIX["constraints"][dependencies],
        ]  # fmt: skip
        done = subprocess.run(words, cwd=temporary).returncode == 0
        inside = place / "venv" / "bin" / "python"
        done = done and import_is_quick(inside) and fast_tests(inside, dependencies)
    print(f"Python {version}, {dependencies} dependencies: {'ok' if done else 'FAILED'}", flush=True)
    return done


def import_is_quick(python: Path) -> bool:
    """Say whether `import lungaccess` costs less than a share of numpy's import, by processor time."""
    share = import_cost(python, "lungaccess") / import_cost(python, "numpy")
    limit = MATRIX["limits"]["import_over_numpy"]
    print(
        f"import lungaccess: {share:.2f} of the processor time of import numpy, at most {limit}", flush=True
    )
    return share <= limit


def import_cost(python: Path, module: str) -> float:
    """Return the least processor time of an import in a new process, s, of several."""
    script = f"import time; t = time.process_time(); import {module}; print(time.process_time() - t)"
    said = [subprocess.run([python, "-I", "-c", script], capture_output=True, text=True, check=True)
            for _ in range(7)]  # fmt: skip
    return min(float(each.stdout) for each in said)


def fast_tests(python: Path, dependencies: str) -> bool:
    """Run the fast part of the tests with the wheel and the libraries of an environment."""
    constraints = MATRIX["constraints"][dependencies]
    pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    told = ["-c", str(ROOT / constraints)] if constraints else []
    subprocess.run([*pip, *told, *MATRIX["tests"]["packages"]], check=True)
    pytest = [str(python), "-m", "pytest", "-q", "-p", "no:cacheprovider", *MATRIX["tests"]["places"]]
    with tempfile.TemporaryDirectory() as tree:
        copy_of((name for name in tracked() if name.split("/")[0] not in PACKAGES), Path(tree))
        return subprocess.run(pytest, cwd=tree).returncode == 0


def try_all(wheel: Path, environments: list[dict[str, str]]) -> int:
    """Try a wheel in each environment that is at hand; name the others."""
    tried, good = 0, True
    for each in environments:
        name = f"Python {each['python']}, {each['dependencies']} dependencies"
        if python_at_hand(each["python"]) is None:
            print(f"{name}: not tried, there is no python{each['python']} here")
        else:
            tried += 1
            good = try_wheel(wheel, each) and good
    if not tried:
        return NOT_AT_HAND
    return 0 if good else 1


def main() -> int:
    """Do what the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("dist", "try", "matrix"))
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder of wheel and sdist")
    parser.add_argument("--python", help="only the environments of this version, such as 3.12")
    parser.add_argument("--dependencies", choices=tuple(MATRIX["constraints"]), help="only those with these")
    asked = parser.parse_args()
    wanted = [
        each for each in MATRIX["environment"]
        if asked.python in (None, each["python"]) and asked.dependencies in (None, each["dependencies"])
    ]  # fmt: skip
    if asked.what == "matrix":
        print(json.dumps({"include": wanted}))
        return 0
    try:
        wheel, _sdist = build(asked.out.resolve())
    except ReleaseError as error:
        print(error, file=sys.stderr)
        return 1
    if asked.what == "dist":
        from kernels_wheel import build_kernels_wheel

        build_kernels_wheel(asked.out.resolve())
        return 0
    return try_all(wheel, wanted)


if __name__ == "__main__":
    sys.exit(main())
