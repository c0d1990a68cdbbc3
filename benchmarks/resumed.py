"""Rows of a benchmark as lines of files: it goes on where it stopped, and seeds can be split over processes.

    python benchmarks/X.py --seeds 10 --table runs/a.jsonl                # in one process
    python benchmarks/X.py --first 10 --seeds 20 --table runs/b.jsonl     # in another one
    python benchmarks/X.py --seeds 20 --table runs/a.jsonl runs/b.jsonl --show
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable
from pathlib import Path


def arguments(doc: str | None, table: str, seeds: int) -> argparse.ArgumentParser:
    """Return a parser that knows seeds and tables."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=seeds, help="seeds below this number")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--table", type=Path, nargs="+", default=[Path(table)], help="files of rows; new ones go to the first")
    parser.add_argument("--show", action="store_true", help="only print what is there")
    return parser


def seeds(args: argparse.Namespace) -> range:
    """Return the seeds that are asked for."""
    return range(args.first, args.seeds)


def collect(args: argparse.Namespace, jobs: Iterable[dict], run: Callable[..., dict]) -> list[dict]:
    """Return the rows of jobs, each its keys and what `run(**job)` found; those that are missing are run, but for `--show`."""
    lines = [line for path in args.table if path.is_file() for line in path.read_text().splitlines()]
    there, found = [json.loads(line) for line in lines], []
    args.table[0].parent.mkdir(parents=True, exist_ok=True)
    for job in jobs:
        row = next((row for row in there if all(row.get(key) == value for key, value in job.items())), None)
        if row is None and not args.show:
            row = job | run(**job)
            with args.table[0].open("a") as file:
                file.write(json.dumps(row) + "\n")
        found += [] if row is None else [row]
    return found
