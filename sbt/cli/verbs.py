"""The verbs of the command line; nothing heavy is imported before one needs it."""

from __future__ import annotations

from typing import Annotated

import typer

from sbt import __version__
from sbt.cli import campaign, inform, metrics, scenario
from sbt.cli.benchmark import benchmark
from sbt.cli.compare import compare
from sbt.cli.compare_ego import compare_ego
from sbt.cli.console import verb
from sbt.cli.estimate_again import estimate_again
from sbt.cli.flags import PlainFlags, PlainGroup
from sbt.cli.new import new
from sbt.cli.pin import pin
from sbt.cli.predict import predict
from sbt.cli.replay import replay
from sbt.cli.serve import serve

__all__ = ["app"]

app = typer.Typer(
    name="sumo-sbt",
    cls=PlainGroup,
    help="Scenario-based testing of automated vehicles on SUMO.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
for _verb in (
    campaign.run,
    campaign.merge,
    scenario.simulate,
    scenario.check,
    campaign.status,
    campaign.report,
    campaign.export,
    campaign.bundle,
    predict,
    estimate_again,
    replay,
    pin,
):
    app.command(cls=PlainFlags)(verb(_verb))
app.command(cls=PlainFlags)(verb(metrics.metrics))
app.command(cls=PlainFlags)(verb(new))
app.command(cls=PlainFlags)(verb(benchmark))
app.command(cls=PlainFlags)(verb(compare))
app.command(cls=PlainFlags)(verb(compare_ego))
app.command(cls=PlainFlags)(verb(serve))
app.command("list", cls=PlainFlags)(verb(inform.list_))
app.command(cls=PlainFlags)(verb(inform.schema))
app.command(cls=PlainFlags)(verb(inform.doctor))


def _version(value: bool) -> None:
    if value:
        print(f"sumo-sbt {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    *,
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Print it.")] = False,
) -> None:
    """Scenario-based testing of automated vehicles on SUMO."""
