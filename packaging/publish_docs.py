"""Put built pages beside those of other versions, for any host of static files.

    python packaging/publish_docs.py SITE FOLDER

SITE is what `make docs` built.  FOLDER gets a folder of that version, and an `index.html` that leads to the
newest release.  Pages of a version that is there already are replaced in one step.  Every page of every
version then links to the same page of the others, or to their first page where they have none.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import sys
from pathlib import Path

PLACE = re.compile(r'(<div id="versions"[^>]*>).*?(</div>)', re.DOTALL)
"""The part of a page that `docs/_templates/sidebar/versions.html` leaves for the versions."""
NUMBER = re.compile(r"\d+(?:\.\d+)+")
INDEX = """<!doctype html>
<meta charset="utf-8">
<title>lungaccess</title>
<meta http-equiv="refresh" content="0; url={newest}/index.html">
<a href="{newest}/index.html">lungaccess {newest}</a>
"""


class PublishError(Exception):
    """A folder that is no built documentation."""


def publish(site: Path, folder: Path) -> list[str]:
    """Copy the pages of a version and return all versions, newest first.

    Raises:
        PublishError: If `site` is not what `make docs` builds.
    """
    try:
        version = (site / "version.txt").read_text(encoding="utf-8").strip()
    except OSError as error:
        raise PublishError(f"{site} has no version.txt: build the pages with `make docs`") from error
    if not NUMBER.fullmatch(version) or not (site / "index.html").is_file():
        raise PublishError(f"{site} holds no pages of a version: build them with `make docs`")
    folder.mkdir(parents=True, exist_ok=True)
    new, old = folder / f".{version}.new", folder / f".{version}.old"
    for left_over in (new, old):
        shutil.rmtree(left_over, ignore_errors=True)
    shutil.copytree(site, new)
    if (folder / version).exists():
        (folder / version).rename(old)
    new.rename(folder / version)
    shutil.rmtree(old, ignore_errors=True)
    versions = [each.name for each in folder.iterdir() if NUMBER.fullmatch(each.name) and each.is_dir()]
    versions.sort(key=lambda name: [int(part) for part in name.split(".")], reverse=True)
    for each in versions:
        _link_versions(folder, each, versions)
    _write(folder / "index.html", INDEX.format(newest=versions[0]))
    return versions


def _link_versions(folder: Path, version: str, versions: list[str]) -> None:
    """Let every page of a version link to the same page of all versions."""
    for page in (folder / version).rglob("*.html"):
        same = page.relative_to(folder / version)
        up = "../" * len(same.parts)
        pages = {each: same if (folder / each / same).is_file() else "index.html" for each in versions}
        links = (f'<a href="{up}{each}/{pages[each]}">{each}</a>' for each in versions if each != version)
        text = page.read_text(encoding="utf-8")
        linked = PLACE.sub(rf"\1Version {' '.join([version, *links])}\2", text, count=1)
        if linked != text:
            _write(page, linked)


def _write(file: Path, text: str) -> None:
    temporary = file.with_name(f".{file.name}.new")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, file)


def main() -> int:
    """Publish what the command line names."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("site", type=Path)
    parser.add_argument("folder", type=Path)
    asked = parser.parse_args()
    try:
        print("\n".join(publish(asked.site, asked.folder)))
    except PublishError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
