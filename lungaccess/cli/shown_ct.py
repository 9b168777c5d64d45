"""The CT that commands show in their slices."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from lungaccess.cli import terminal

if TYPE_CHECKING:
    from lungaccess.showing.report.html.volumes import CtFile

CtOption = Annotated[
    Path | None,
    Parameter(
        help="CT for the slices, an image file or a folder of DICOM; else ct.nii.gz of the patient's folder, "
        "the CT that was segmented, or the structures of the masks."
    ),
]


def shown_ct(stated: Path | None, patient: Path) -> "CtFile | None":
    """Return the CT that was stated, else the patient's; without one, a warning says where it was looked for.

    Raises:
        FileError: If the record of the patient's segmentation is damaged.
    """
    from lungaccess.showing.report.html.volumes import CtFile, find_ct

    found = find_ct(patient) if stated is None else CtFile(path=stated)
    if found is None or found.path.exists() or stated is not None:
        return found
    terminal.progress_console.print(
        f"The CT that was segmented is no longer at {found.path}, so that slices show the masks; "
        "--ct says where it is.",
        highlight=False,
    )
    return None
