"""The command `lungaccess design`: the numbers of a device that reach most of a cohort."""

import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from lungaccess.cli import terminal
from lungaccess.cli.commands.template import template_text
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import Processes
from lungaccess.cli.options import CacheOptions
from lungaccess.cli.progress import progress
from lungaccess.cli.result_folder import claim_folder

if TYPE_CHECKING:
    from lungaccess.running.design.search import DesignFound


def design(
    design: Path | None = None,
    *,
    out: Path = Path("lungaccess-design"),
    scheduler: str | None = None,
    workers: Annotated[Processes | None, Parameter(name="--workers")] = None,
    output: CacheOptions = CacheOptions(),
) -> ExitCode:
    """Search the numbers of a device that reach most targets of a cohort, or most often succeed there.

    Stop it at any time and start it again: it goes on from what is stored.  Exit code 1 if the best device
    reaches no target.

    Args:
        design: TOML file of the search; that of `lungaccess template design`, on a synthetic patient, if not
            given.
        out: Folder for the runs, the record, the picture and the devices found.
        scheduler: Address of a running dask scheduler, such as tcp://host:8786; this machine if not given.
        workers: How many processes on this machine; as many as it has cores if not given.
    """
    from anatomy.base.settings import settings_toml
    from lungaccess.running.design.search import run_design
    from lungaccess.running.design.settings import design_of, read_design
    from lungaccess.showing.report import front_png

    asked = read_design(design) if design else design_of(tomllib.loads(template_text("design")))
    claim_folder(out, ())
    with progress(asked.study.name) as shown:
        found = run_design(
            asked, out, scheduler=scheduler, workers=workers, cache=output.cache, progress=shown.step
        )
    best = found.front[0]
    values = {each.system.name: each.values for each in found.counted}
    front_png(found.criteria, values, [each.system.name for each in found.front], out / "front.png")
    if output.json:
        terminal.show_json(found.record())
        return ExitCode.of(any(best.reached))
    _show(asked.study.name, found)
    terminal.console.print(settings_toml(best.system), soft_wrap=True)
    terminal.say(f"Written to {out}: device.toml, the device above; front/, design.json, front.png")
    return ExitCode.of(any(best.reached))


def _show(title: str, found: "DesignFound") -> None:
    """Print the first device and the front, and how many others were tried or refused."""
    devices = found.record()["devices"]
    first = found.counted[0].system.name
    numbers = {each.system.name: f"{n}" for n, each in enumerate(found.front, start=1)}
    keys = [number.key for number in found.design.vary]
    rows = [
        (
            numbers.get(name, ""),
            name,
            *(_shown(devices[name]["numbers"][key]) for key in keys),
            "{reached} of {targets}".format(**devices[name]),
            *map(_shown, devices[name]["values"].values()),
        )
        for name in dict.fromkeys([first, *numbers])
    ]
    terminal.show_wide([terminal.table(title, ("front", "device", *keys, "reached", *found.criteria), rows)])
    terminal.say(f"{found.tried} devices were tried, {len(found.counted) - 1} of them on all targets.")
    for count, words in found.refused.values():
        terminal.say(f"The validator of devices refused {count}, as here: {words}")


def _shown(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else f"{value}"
