"""The commands `lungaccess info` and `lungaccess presets`: what is known of patients and systems."""

from __future__ import annotations

from pathlib import Path

from anatomy.io.files import require_writable_folder
from lungaccess.cli import terminal
from lungaccess.cli.commands.common import OK, print_warnings
from lungaccess.cli.inputs import load_lung
from lungaccess.cli.terminal import console


def info(patient: Path, *, out: Path | None = None, json: bool = False, cache: Path | None = None) -> int:
    """Show what was understood of a patient: volumes, airway tree, sources and warnings.

    Parameters
    ----------
    patient : Path
        Folder of masks.
    out : Path
        Folder for tree.png, a picture of the airway tree.
    json : bool
        Print JSON instead of tables.
    cache : Path
        Folder where the prepared anatomy is kept for the next command.
    """
    if out is not None:
        require_writable_folder(out)
    lung = load_lung(patient, cache, thick_slices=True)
    if json:
        from lungaccess.cli.records import lung_record

        terminal.show_json(lung_record(lung))
    else:
        terminal.show(terminal.anatomy_tables(lung))
        print_warnings(lung)
    if out is not None:
        from lungaccess.report import tree_png

        picture = tree_png(lung, out / "tree.png")
        if not json:
            console.print(f"Picture of the tree: {picture}")
    return OK


def presets(*, json: bool = False) -> int:
    """List the systems that ship with lungaccess.

    Parameters
    ----------
    json : bool
        Print JSON, with every setting, instead of a table.
    """
    from anatomy.settings import to_mapping
    from lungaccess.problem.system import load_system, preset_names

    systems = {name: load_system(name) for name in preset_names()}
    if json:
        terminal.show_json({name: to_mapping(system) for name, system in systems.items()})
    else:
        console.print(terminal.preset_table(systems))
    return OK
