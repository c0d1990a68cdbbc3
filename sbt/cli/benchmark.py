"""The verb benchmark: the paper's experiment."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from sbt.cli.console import Exit, ProgressDisplay, clean_stdout, fail, next_command, print_json, resumable
from sbt.errors import FailedRunsError, InputError

__all__ = ["benchmark"]


def benchmark(
    config: Annotated[Path, typer.Argument(metavar="CONFIG.yaml", help="Configuration of the benchmark.")],
    *,
    store: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder of the results.")] = None,
    changes: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY.PATH=VALUE", help="Change one key; repeatable.")
    ] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Cells at the same time.")] = None,
    reference_only: Annotated[bool, typer.Option("--reference-only", help="Only make the reference runs.")] = False,
    figures_only: Annotated[bool, typer.Option("--figures-only", help="Only the table and figures of what is done.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as one JSON object.")] = False,
) -> None:
    """Compare metamodels on scenarios, with even and boundary samples, or go on where it was interrupted."""
    overrides = list(changes or [])
    if store is not None:
        overrides.append(f"--store={store}")
    if workers is not None:
        overrides.append(f"workers={workers}")
    silent = quiet or as_json
    with resumable("*", "run again to go on") as work, clean_stdout(), ProgressDisplay(silent=silent) as show:
        from sbt.config.benchmark import load_benchmark

        loaded = load_benchmark(config, overrides)
        from sbt.benchmark.experiment import Listener, run_benchmark

        told: list[str] = []

        def tell(line: str) -> None:
            if not silent:
                told.append(line)
                print(line, file=sys.stderr, flush=True)

        listener = Listener(tell, show)
        simulate = not (reference_only or figures_only)
        work.folder = Path(loaded.config.store)
        result = run_benchmark(loaded, listener, reference=not figures_only, cells=simulate, figures=not reference_only)
    if as_json:
        print_json(result)
    else:
        if reference_only:
            print("\n".join(f"reference runs: {folder}" for folder in result["references"]))
        left_out = f", {result['left_out']} left out" if result["left_out"] else ""
        print(f"{result['done']} of {result['cells']} cells done, {len(result['failed'])} failed{left_out}")
        print(f"table: {result['table']}, {len(result['figures'])} figures" if result["table"] else f"store: {result['store']}")
        if result["done"] < result["cells"] and not (figures_only or result["failing"]):
            next_command("sumo-sbt", "benchmark", config)
    if result["failed"] or result["failing"]:
        lines = [f"{name}: {why}" for name, why in (*result["failing"].items(), *result["failed"].items())]
        untold = "\n".join(line for line in lines if line not in told)
        code = _verdict(result)
        raise fail(untold, code) if untold else typer.Exit(int(code))


def _verdict(result: Mapping[str, Any]) -> Exit:
    """Return the exit code of a benchmark in which cells or too many runs failed."""
    errors = result["failed"].values()
    if result["failing"] or any(isinstance(error, FailedRunsError) for error in errors):
        return Exit.FAILED_RUNS
    return Exit.INPUT if all(isinstance(error, InputError) for error in errors) else Exit.INTERNAL
