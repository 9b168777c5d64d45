"""The wheel `lungaccess-kernels`: machine code for this platform, Python and numba, made beforehand."""

from __future__ import annotations

import base64
import hashlib
import subprocess
import sys
import zipfile
from importlib.metadata import distribution, version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FILES_OF_CALLS = """
from anatomy.machine_code.ahead import code_files, compile_ahead

compile_ahead([])
print("\\n".join(map(str, code_files())))
"""


def build_kernels_wheel(out: Path) -> Path:
    """Compile all kernels that are written down, on all cores, and pack them; return the wheel.

    What this machine has compiled before is not compiled again.
    """
    said = subprocess.run(
        [sys.executable, "-c", FILES_OF_CALLS], cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True
    )
    files = [Path(line) for line in said.stdout.split("\n") if line]
    release, tags = version("lungaccess"), platform_tags()
    wheel = out / f"lungaccess_kernels-{release}-{compressed(tags)}.whl"
    contents = {"lungaccess_kernels/__init__.py": b'"""Machine code of the kernels of lungaccess."""\n'}
    contents |= {"/".join(("lungaccess_kernels", *file.parts[-3:])): file.read_bytes() for file in files}
    about = f"lungaccess_kernels-{release}.dist-info"
    contents[f"{about}/METADATA"] = metadata(release).encode()
    kind = ["Wheel-Version: 1.0", "Generator: lungaccess", "Root-Is-Purelib: true"]
    kind += [f"Tag: {tag}" for tag in tags]
    contents[f"{about}/WHEEL"] = "\n".join([*kind, ""]).encode()
    write_wheel(wheel, contents, f"{about}/RECORD")
    print(f"{wheel.name}: {wheel.stat().st_size / 1e6:.1f} MB, code of {len(files)} calls of kernels")
    return wheel


def platform_tags() -> list[str]:
    """Return the tags of the wheel, those of numba's own: its platforms are those that the code is for."""
    stated = (distribution("numba").read_text("WHEEL") or "").splitlines()
    return [line.partition(": ")[2] for line in stated if line.startswith("Tag: ")]


def compressed(tags: list[str]) -> str:
    """Return tags as the name of a wheel states them: each part once."""
    parts = zip(*(tag.split("-") for tag in tags), strict=True)
    return "-".join(".".join(dict.fromkeys(part)) for part in parts)


def metadata(release: str) -> str:
    """Return what an installer reads: the code is for one numba alone."""
    return "\n".join(
        [
            "Metadata-Version: 2.1",
            "Name: lungaccess-kernels",
            f"Version: {release}",
            "Summary: Machine code of the kernels of lungaccess: its first command need not compile.",
            "License: BSD-3-Clause",
            f"Requires-Dist: lungaccess=={release}",
            f"Requires-Dist: numba=={version('numba')}",
            "",
        ]
    )


def write_wheel(wheel: Path, contents: dict[str, bytes], record: str) -> None:
    """Write a wheel with the list of its files and their hashes; the same contents give the same wheel."""
    lines = [f"{name},sha256={hash_of(data)},{len(data)}" for name, data in sorted(contents.items())]
    contents = contents | {record: "\n".join([*lines, f"{record},,", ""]).encode()}
    wheel.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, data in contents.items():
            archive.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_DEFLATED)


def hash_of(data: bytes) -> str:
    """Return the hash of a file as the list of a wheel states it."""
    return base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
