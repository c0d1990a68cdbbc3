"""The verb `new`: a commented scenario.yaml for existing SUMO files."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sbt.cli.console import clean_stdout
from sbt.errors import InputError

if TYPE_CHECKING:
    from sbt.sumo.files import SumoFiles
    from sbt.sumo.template import Template

__all__ = ["new"]

_SCENARIO = """\
# A logical scenario of your own SUMO files. Try it: sumo-sbt check {folder}/scenario.yaml
# A placeholder such as ${{{first}}}, or a formula such as ${{100 + {first}}}, may stand in every attribute of the
# files and in every option; every input below must stand in one.

sumo:                       # or just: sumo: my.sumocfg
  config: {config}
{routes}  options: {{}}               # further SUMO options, such as {{scale: 1.2, insertion-checks: none}}

inputs:                     # min, max, and if you like: unit, distribution, kind: integer, description
{inputs}
ego:                        # the vehicle under test
  id: {ego}
  may_leave: true           # arriving early is no failure
  # kind: acc_aeb           # drive it by a controller, file.py:NAME for your own; or {{kind: sumo, model: IDM, tau: 1.2}}

others: {{within: 100}}       # record everybody who comes this near (m); named: [lead] records lead wherever it is
duration: {duration}                # from the ego's departure on (s)
wait: {wait}                    # longest time until it departs (s)
{step}
metrics:                    # of ego and each of the others, the worst counts; other: lead asks for that one
  - ttc_2d_min
  - collision
  - {{stl: "G(distance > 0.5)", name: keeps_clear}}

requirement: {{metric: ttc_2d_min, critical: [-.inf, 1.0]}}
"""
_CAMPAIGN = """\
# Run it: sumo-sbt run {folder}/campaign.yaml
campaign: coverage
scenario: scenario.yaml
seed: 1
budget: 20
"""


def new(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Where scenario.yaml shall go.")],
    *,
    config: Annotated[Path, typer.Option("--from", metavar="MY.sumocfg", help="Your SUMO configuration.")],
    ego: Annotated[
        str | None, typer.Option(metavar="ID", help="The vehicle under test; default: the first of the files.")
    ] = None,
) -> None:
    """Write a commented scenario.yaml and campaign.yaml for your own SUMO files, which stay as they are."""
    with clean_stdout():
        written = write_scenario(folder, config, ego)
    for path in written:
        print(path)


def write_scenario(folder: Path, config: Path, ego: str | None = None) -> list[Path]:
    """Write the files and return them.

    A route file without placeholders is copied, so that the ego's speedFactor can be the first input.

    Raises:
        InputError: the configuration cannot be read, has no such vehicle, or there is a scenario already.
    """
    from sbt.sumo.departures import number_or_none
    from sbt.sumo.files import SumoFiles, options_of_config

    if (folder / "scenario.yaml").exists():
        raise InputError(f"FOLDER must not have a scenario.yaml yet, but '{folder}' has")
    files = SumoFiles.of(options_of_config(config), config.resolve().parent, str(config))
    vehicles = [name for t in files.templates for name, v in t.vehicles.items() if v.tag != "flow"]
    names = vehicles or [f"{name}.0" for name in files.names()]
    ego = ego or (names[0] if names else "")
    found = files.vehicle(ego)
    if found is None:
        raise InputError(f"--ego must be a vehicle of the files ({', '.join(names[:8]) or 'none'}), but got '{ego}'")
    folder.mkdir(parents=True, exist_ok=True)
    inputs = {name: "{min: 0.0, max: 1.0}    # your range" for hole in files.placeholders() for name in hole.formula.names()}
    written, routes = [], ""
    if not inputs:
        inputs = {"speed_factor": "{min: 0.8, max: 1.2}    # of the ego: its speed by the allowed one"}
        source = found[1]
        copy = _copied(files, source, ego, folder)
        written.append(copy)
        routes = f"  routes: [{', '.join(_relative(copy if p == source.path else p, folder) for p in files.routes)}]\n"
    depart = number_or_none(found[0].depart)
    wait = 3600.0 if depart is None else depart + 60.0
    step = "" if files.step_length() is not None else "step_length: 0.1            # SUMO's own default is 1 s\n"
    scenario = _SCENARIO.format(
        folder=folder, config=_relative(config.resolve(), folder), routes=routes, ego=ego, duration=30,
        wait=f"{wait:g}", step=step, first=next(iter(inputs)),
        inputs="".join(f"  {name}: {entry}\n" for name, entry in inputs.items()),
    )  # fmt: skip
    for name, text in (("scenario.yaml", scenario), ("campaign.yaml", _CAMPAIGN.format(folder=folder))):
        (folder / name).write_text(text)
        written.append(folder / name)
    return written


def _relative(path: Path, folder: Path) -> str:
    return os.path.relpath(path.resolve(), folder.resolve())


def _copied(files: SumoFiles, source: Template, ego: str, folder: Path) -> Path:
    """Copy the ego's route file with a placeholder as its speedFactor; what it includes stays where it is.

    Raises:
        InputError: the ego stands in an included file, or its file is packed.
    """
    if source.path not in files.routes or source.path.suffix == ".gz":
        raise InputError(
            f"the ego must stand in a route file that is named by the configuration, but '{ego}' is in {source.path}"
        )
    target = folder / source.path.name
    if target.exists():
        raise InputError(f"FOLDER must not have a {source.path.name}, but '{folder}' has: choose another folder")
    data = source.path.read_bytes()
    for part in reversed(source.parts):
        if part.target is not None:
            data = data[: part.start] + f'"{_relative(part.target, folder)}"'.encode() + data[part.end :]
    text = data.decode()
    names = "|".join(re.escape(n) for n in (ego, ego.rpartition(".")[0]) if n)
    tag = re.compile(rf"<(?:vehicle|trip|flow)\b(?=[^>]*\sid=[\"'](?:{names})[\"'])[^>]*?(?=\s*/?>)")
    found = tag.search(text)
    if found is None:
        raise InputError(f"the ego '{ego}' must stand in {source.path} as a vehicle, trip or flow, but does not")
    opened = re.sub(r"\sspeedFactor=(\"[^\"]*\"|'[^']*')", "", found.group())
    target.write_text(text[: found.start()] + f'{opened} speedFactor="${{speed_factor}}"' + text[found.end() :])
    return target
