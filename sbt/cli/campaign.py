"""The verbs of a campaign: run, merge, status, report, export."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from sbt.cli.completion import complete_stores
from sbt.cli.conclusion import conclusion_lines, show_conclusion, shown
from sbt.cli.console import (
    Exit,
    ProgressDisplay,
    clean_stdout,
    fail,
    fail_where_most_failed,
    next_command,
    print_json,
    resumable,
)
from sbt.cli.progress import duration
from sbt.errors import InputError
from sbt.plugins.approval import trust_store

__all__ = ["bundle", "export", "merge", "report", "run", "status"]

_EVERY = 2.0
"""Seconds between two looks of `status --watch`."""
_STARTING = 10.0
"""Seconds that `status --watch` waits for the process of a campaign that nobody runs: it may just be starting."""
_STATES = {
    "interrupted": ": it was interrupted; run it again to go on",
    "dead": ": its process was killed; run it again to go on, nothing is lost but the runs in flight",
    "elsewhere": ": another machine writes it, or did when it was killed",
}
"""What to make of a campaign that has not concluded, by its state."""
_SCORES = ("log_likelihood", "rmse", "average_precision", "precision_at_recall_90", "calibration_error")
"""Scores of the last validation that `status` prints."""

Folder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a campaign (its store).", autocompletion=complete_stores)]
FailOnCritical = Annotated[bool, typer.Option("--fail-on-critical", help="Exit 3 if a critical scenario was found.")]
JUnit = Annotated[
    Path | None, typer.Option("--junit", metavar="FILE.xml", help="Write the verdict as JUnit XML, for a CI's view.")
]
Trust = Annotated[
    bool, typer.Option("--trust", help="Approve the code (file.py) that the store names, with the content that it has now.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as one JSON object.")]
Verbose = Annotated[bool, typer.Option("--verbose", help="Print every number of the conclusion.")]


def run(
    config: Annotated[Path, typer.Argument(metavar="CONFIG.yaml", help="Configuration of the campaign.")],
    *,
    store: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder of the results.")] = None,
    changes: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY.PATH=VALUE", help="Change one key; repeatable.")
    ] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Worker processes.")] = None,
    shard: Annotated[
        str | None,
        typer.Option(metavar="I/N", help="Only every N-th run, into STORE/shard-I-of-N or --store; merge joins them."),
    ] = None,
    fail_on_critical: FailOnCritical = False,
    junit: JUnit = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress.")] = False,
    as_json: AsJson = False,
    verbose: Verbose = False,
) -> None:
    """Run a campaign, or resume it where it was interrupted."""
    overrides = list(changes or [])
    if store is not None:
        overrides.append(f"--store={store}")
    if workers is not None:
        overrides.append(f"executor.workers={workers}")
    with resumable() as work, clean_stdout(), ProgressDisplay(silent=quiet or as_json) as show:
        from sbt.workflows.running import run_study
        from sbt.workflows.study import Study

        study, part = Study.from_file(config, overrides), None
        if shard is not None:
            study, part = study.sharded(shard, apart=store is None)
        work.folder = Path(study.config.store)
        result = run_study(study, progress=show, shard=part).to_dict()
    _conclude(result, fail_on_critical=fail_on_critical, junit=junit, as_json=as_json, verbose=verbose)


def merge(
    folders: Annotated[list[Path], typer.Argument(metavar="DIR...", help="The stores of all shards of one campaign.")],
    *,
    into: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the whole campaign.")],
    fail_on_critical: FailOnCritical = False,
    junit: JUnit = None,
    trust: Trust = False,
    as_json: AsJson = False,
    verbose: Verbose = False,
) -> None:
    """Join the stores of shards (run --shard) into the one that a run without shards would have written."""
    with clean_stdout():
        from sbt.workflows.merging import merge_shards

        result = merge_shards([with_store(folder, trust=trust) for folder in folders], into).to_dict()
    _conclude(result, fail_on_critical=fail_on_critical, junit=junit, as_json=as_json, verbose=verbose)


def _conclude(result: Mapping[str, Any], *, fail_on_critical: bool, junit: Path | None, as_json: bool, verbose: bool) -> None:
    """Print the result of a campaign; raise the exit of its verdict, where that is not 0."""
    if junit is not None:
        from sbt.report.junit import write_junit

        write_junit(junit, result, fail_on_critical=fail_on_critical)
    if as_json:
        print_json(result)
    else:
        show_conclusion(result, verbose=verbose)
    gate = result["conclusion"].get("gate")
    if gate is not None and gate["verdict"] != "pass":
        raise fail(f"gate {gate['verdict']}: {gate['statement']}", Exit.CRITICAL)
    if fail_on_critical and result["critical"] > 0:
        raise fail(f"{result['critical']} critical runs", Exit.CRITICAL)
    fail_where_most_failed(result["failed"], result["runs"], "; the report and `sumo-sbt export` show why")


def status(
    folder: Folder,
    *,
    watch: Annotated[bool, typer.Option("--watch", help="Repeat until nobody runs the campaign any more, for 10 s.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Print the progress of a campaign, also while it runs."""
    found, told, seen = _status(folder), "", time.monotonic()
    try:
        while watch and not getattr(sys.stdout, "gone", False):
            seen = time.monotonic() if found["state"] == "running" else seen
            if found["state"] == "finished" or time.monotonic() - seen > _STARTING:
                break
            line = _progress_line(found)
            if not as_json and line != told:
                print(line, flush=True)
            told = line
            time.sleep(_EVERY)
            found = _status(folder)
    except KeyboardInterrupt:
        pass
    if as_json:
        print_json(found)
        return
    print("\n".join(_status_lines(found)))
    if found["state"] == "dead" or (found["state"] == "interrupted" and found["conclusion"] is None):
        next_command("sumo-sbt", "run", folder / "config.resolved.yaml")


def _status(folder: Path) -> dict[str, Any]:
    """Return counts, iteration, last validation and conclusion."""
    with clean_stdout():
        from sbt.workflows.status import read_status

        return read_status(with_store(folder))


def _status_lines(found: Mapping[str, Any]) -> list[str]:
    counts = ", ".join(f"{n} {name}" for name, n in sorted(found["runs"].items())) or "none planned"
    coarse = f", {found['coarse_runs']} coarse ones beside them" if "coarse_runs" in found else ""
    lines = [_progress_line(found), f"  runs: {counts}{coarse}; {found['iterations']} iterations"]
    if found["validation"] is not None:
        scores = (f"{key.replace('_', ' ')} {shown(found['validation'].get(key))}" for key in _SCORES)
        lines.append("  validation: " + ", ".join(scores))
    if found["conclusion"] is None:
        return [*lines, f"  not finished{_STATES.get(found['state'], '')}"]
    return [*lines, *conclusion_lines({**found["conclusion"], "store": found["store"]})]


def _progress_line(found: Mapping[str, Any]) -> str:
    """Return how far a campaign is, and how long it takes."""
    done, budget = found["done"], found["budget"]
    told = f"{found['store']}: {found['state']}, {done:,}"
    told += f" of {budget:,} runs" if budget is not None and done <= budget else " runs"
    if budget is not None and done > budget:
        told += f" ({budget:,} budgeted, {done - budget:,} beside them, such as those that confirm failures)"
    if found["rate"] is not None:
        told += f", {found['rate']:.3g} a second"
    return told + (f", {duration(found['remaining'])} left" if found["remaining"] is not None else "")


def report(folder: Folder, *, trust: Trust = False) -> None:
    """Write the report of a campaign again."""
    with clean_stdout():
        from sbt.workflows.running import rebuild_report

        path = rebuild_report(with_store(folder, trust=trust), told=lambda note: print(f"warning: {note}", file=sys.stderr))
    print(path)
    next_command("sumo-sbt", "export", folder, "--format", "csv")


def export(
    folder: Folder,
    *,
    form: Annotated[
        str,
        typer.Option("--format", metavar="csv|parquet|dsiod|boundary", help="boundary: points where P(critical) is 0.5."),
    ] = "csv",
    trust: Trust = False,
) -> None:
    """Write the runs of a campaign as a table."""
    with clean_stdout():
        from sbt.workflows.exporting import export_store, limits_of

        store = with_store(folder, trust=trust)
        limits, path = limits_of(store, form), export_store(store, form)  # in this order: runs may come meanwhile
    print(path)
    for limit in limits:
        print(f"note: {limit}", file=sys.stderr)
    next_command("sumo-sbt", "report", folder)


def bundle(
    folder: Folder,
    *,
    to: Annotated[Path | None, typer.Option("--to", metavar="FILE.zip", help="Default: DIR.zip.")] = None,
    trust: Trust = False,
) -> None:
    """Pack a campaign with the files of its scenario, so that it replays on another machine."""
    with clean_stdout():
        from sbt.workflows.running import bundle_store

        store = with_store(folder, trust=trust)
        target = store.resolve().with_name(f"{store.resolve().name}.zip") if to is None else to
        files = bundle_store(store, target)
    print("\n".join([str(target), *(f"  {path}" for path in files)]))


def with_store(folder: Path, *, trust: bool = False) -> Path:
    """Return the folder if a campaign is in it; approve the code that it names where the user says so."""
    if not (folder / "campaign.sqlite").is_file():
        raise InputError(f"DIR must be the folder of a campaign (with campaign.sqlite), but got '{folder}'")
    if trust:
        trust_store(folder)
    return folder
