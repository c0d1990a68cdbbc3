"""What kills and damage do: what is left behind, and whether a campaign's rows are those of one that was left alone.

    python benchmarks/faults.py [--kills 50] [--seed 1] [--only coverage report ...] [--by KILL TERM ...] [--table FILE.jsonl]
    python benchmarks/faults.py --corruptions 200   # single bits, and 60 times eight bits, of a finished store

Each part first measures how long the work takes undisturbed; the moments are spread over that time, from the start of
the process to its end, in random order. A campaign that was killed is run again, and killed again, until it ends; its
rows, batches and conclusion are then compared with those of one that was left alone (`serial`). A command that was
killed (report, export, bundle, merge, doctor --save) must leave what it writes whole or absent, and is then repeated.
`workers`: the worker processes of a campaign are killed, its driver is not. `storm`: half of the runs kill their worker.
Processes are found by a variable of their environment, at most five seconds after each kill; files left are those in
TMPDIR and in the folders of the results, after work that ended. With `--table` parts that are in the file are not
made again.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import shutil
import signal
import time
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from disturbing import (
    DISTURBING,
    WAYS,
    Found,
    Place,
    configured,
    content,
    disturb,
    moments,
    names_in,
    place,
    stage_of,
    table,
)

import sbt
from sbt.seeds import stream
from sbt.store.database import DATABASE
from sbt.store.rescue import examine, save

KINDS = ("coverage", "boundary", "falsification", "estimation")
COMMANDS = ("report", "export", "bundle", "merge", "doctor")
LOCAL, SERIAL = {"kind": "local", "workers": 2}, {"kind": "serial"}
DASK = {"kind": "dask", "workers": 2}
SIZE = {"budget": 24, "initial": 8, "batch": 8}
_REPEAT = 5
"""Kills of a command after which it is run to its end."""
KILLED = ("crashed", "the worker process died, also when this run was tried again alone")


def campaigns(there: Place, kind: str, n: int, ways: Sequence[str], executor: dict[str, Any], seed: int) -> Found:
    """Disturb campaigns of a kind n times."""
    (there.folder / "runs.py").write_text(DISTURBING)
    keys = {"campaign": kind, "scenario": "runs.py:BRANCHES", **SIZE}
    alone = configured(there, "alone", SERIAL, **keys)
    killed, store = configured(there, "killed", executor, **keys), there.folder / "killed"
    there.alone("run", alone)
    life, right = there.alone("run", killed), content(there.folder / "alone")
    files = names_in(store)
    shutil.rmtree(store)
    found = Found()

    def ended(code: int, printed: str) -> None:
        found.wholes += 1
        found.leftover(names_in(store) - files | names_in(there.temporary))  # before reading, which leaves SQLite's own
        found.equal += content(store) == right
        found.wrong += [] if code == 0 else [f"exit {code}: {printed[-200:]}"]
        shutil.rmtree(store)

    def to_its_end() -> None:
        process = there.start("run", killed)
        printed = process.communicate()[0].decode(errors="replace")
        found.processes += there.left()
        ended(process.returncode, printed)

    for k, moment in enumerate(moments(n, life, seed, kind)):
        way, hit, tries = ways[k % len(ways)], False, 0
        while not hit:
            process = there.start("run", killed)
            hit, printed = disturb(there, process, moment * 0.9 ** (tries // 2), way)
            tries += 1
            found.processes += len(there.living()) and there.left()
            found.wrong += ["traceback"] if "Traceback" in printed else []
            if process.returncode == 0:
                ended(0, printed)
        where = stage_of(store) if process.returncode else "went on"
        found.kills[where] = found.kills.get(where, 0) + 1
        apart = process.returncode < 0 and (not printed or "report: " in printed)  # before Python could answer, or all was done
        if way not in ("KILL", "ALL", "PIPE") and process.returncode not in (0, 130) and not apart:
            found.wrong.append(f"exit {process.returncode} after {way} in {where}")
        if where == "report":  # whatever comes now comes after the last run
            to_its_end()
    if store.exists():
        to_its_end()
    return found


@dataclass(frozen=True)
class Command:
    """A command that reads or joins stores.

    Args:
        there: where it runs.
        words: of the command line.
        made: the file that it writes.
        store: it writes a store, into the folder of `made`, and only where there is none.
    """

    there: Place
    words: tuple[object, ...]
    made: Path
    store: bool = False

    def whole(self) -> Any:
        """Return what was made, in a form that can be compared; raises where it is not whole."""
        if self.store:
            return content(self.made.parent)
        if self.made.suffix == ".zip":
            with zipfile.ZipFile(self.made) as bundle:
                bundle.testzip()
                return sorted((each.filename, each.CRC) for each in bundle.infolist() if not each.filename.endswith(DATABASE))
        data = self.made.read_bytes()
        return data.rstrip().endswith(b"</html>") if self.made.suffix == ".html" else data

    def undo(self) -> None:
        """Remove what was made; of a store what a killed one left stays, since the next one has to remove it."""
        if self.store and self.made.exists():
            shutil.rmtree(self.made.parent)
        self.made.unlink(missing_ok=True)

    def names(self) -> set[str]:
        """Return all files here but SQLite's own, which readers leave."""
        return {name for name in names_in(self.there.folder) if not name.endswith(("-wal", "-shm"))}


def command(there: Place, verb: str) -> Command:
    """Return a command with the store, or the shards, that it needs."""
    store, out = there.folder / "whole", there.folder / "out"
    out.mkdir()
    keys = {"campaign": "coverage", "scenario": "testbed:four_branch_7", **SIZE}
    if verb == "merge":
        config = configured(there, "whole", SERIAL, **keys)
        for k in (1, 2):
            there.alone("run", config, "--shard", f"{k}/2")
        parts = [store / f"shard-{k}-of-2" for k in (1, 2)]
        return Command(there, ("merge", *parts, "--into", out / "merged"), out / "merged" / DATABASE, store=True)
    there.alone("run", configured(there, "whole", SERIAL, **keys, metamodel={"kind": "gp"}))
    return {
        "report": Command(there, ("report", store), store / "report.html"),
        "export": Command(there, ("export", store), store / "exports" / "runs.csv"),
        "bundle": Command(there, ("bundle", store, "--to", out / "b.zip"), out / "b.zip"),
        "doctor": Command(there, ("doctor", store, "--save", out / "saved"), out / "saved" / DATABASE, store=True),
    }[verb]


def commands(there: Place, verb: str, n: int, seed: int) -> Found:
    """Kill a command n times."""
    work, found = command(there, verb), Found()
    work.undo()
    life = there.alone(*work.words)
    right, files = work.whole(), work.names()
    for k, moment in enumerate(moments(n, life, seed, verb)):
        hit = False
        while not hit:
            work.undo()
            hit, printed = disturb(there, there.start(*work.words), moment, "KILL")
            found.processes += len(there.living()) and there.left()
            moment *= 0.9
        where = "with a result" if work.made.exists() else "without"
        found.kills[where] = found.kills.get(where, 0) + 1
        if work.made.exists():
            try:
                found.wrong += [] if work.whole() == right else [f"{verb} is not what it is undisturbed"]
            except Exception as error:
                found.wrong.append(f"{verb} is not whole: {type(error).__name__}")
        found.wrong += ["traceback"] if "Traceback" in printed else []
        if (k + 1) % _REPEAT and k + 1 < n:
            continue
        work.undo()
        again = there.start(*work.words)
        printed = again.communicate()[0].decode()
        found.wholes += 1
        found.equal += again.returncode == 0 and work.whole() == right
        found.wrong += [] if again.returncode == 0 else [f"exit {again.returncode}: {printed[-200:]}"]
        found.leftover(work.names() - files)
    return found


def workers(there: Place, n: int, seed: int, executor: dict[str, Any]) -> Found:
    """Kill worker processes n times, a few of each campaign."""
    (there.folder / "runs.py").write_text(DISTURBING)
    keys = {"campaign": "coverage", "scenario": "runs.py:SLOW", "budget": 300, "initial": 300, "batch": 300}
    there.alone("run", configured(there, "alone", SERIAL, **keys))
    right, rng, found = content(there.folder / "alone"), stream(seed, "workers"), Found()
    killed, store = configured(there, "killed", executor, **keys), there.folder / "killed"
    while sum(found.kills.values()) < n:
        process, once = there.start("run", killed, "--quiet"), 0
        while process.poll() is None and once < 5 and sum(found.kills.values()) < n:
            time.sleep(float(rng.uniform(0.1, 1.5)))
            there_now = there.workers()
            if there_now and process.poll() is None:
                where = stage_of(store)
                try:
                    os.kill(there_now[int(rng.integers(len(there_now)))], signal.SIGKILL)
                except ProcessLookupError:
                    continue
                found.kills[where], once = found.kills.get(where, 0) + 1, once + 1
        printed = process.communicate()[0].decode()
        found.wrong += [] if process.returncode == 0 else [f"exit {process.returncode}: {printed[-200:]}"]
        found.processes += there.left()
        found.wholes, found.equal = found.wholes + 1, found.equal + (content(store) == right)
        found.leftover(names_in(there.temporary))
        shutil.rmtree(store)
    return found


def storm(there: Place, n: int, executor: dict[str, Any]) -> Found:
    """Make n runs of which half kill their worker."""
    (there.folder / "runs.py").write_text(DISTURBING)
    keys = {"campaign": "coverage", "scenario": "runs.py:DEADLY", "budget": n, "initial": n, "batch": n}
    process = there.start("run", configured(there, "storm", executor, **keys), "--quiet")
    printed, found = process.communicate()[0].decode(), Found()
    rows, _, _ = content(there.folder / "storm")
    deadly = [row.inputs["a"] < 0.5 for row in rows]
    found.wholes = len(rows)
    right = ((row.status, row.reason) == KILLED if kills else row.status == "ok" for row, kills in zip(rows, deadly, strict=True))
    found.equal = sum(right)
    found.wrong += [] if process.returncode == 0 else [f"exit {process.returncode}: {printed[-200:]}"]
    loads = len((there.folder / "started").read_text().split())
    found.kills = {f"runs that kill, {loads} processes started": sum(deadly)}
    found.wrong += [] if loads <= 4 * sum(deadly) + 10 else [f"{loads} processes for {sum(deadly)} kills"]
    found.processes = there.left()
    found.leftover(names_in(there.temporary))
    return found


def corruptions(folder: Path, n: int, bits: int, seed: int) -> dict[str, int]:
    """Flip bits of a finished store n times, read it, and save what is whole; counts of what came of it."""
    rng, whole, broken = stream(seed, f"{bits} bits"), folder / "whole", folder / "broken"
    if not whole.exists():
        sbt.run(
            campaign="falsification", scenario="testbed:four_branch_7", budget=60, batch=10, metamodel="gp", executor="serial",
            store=whole, report=False,
        )  # fmt: skip
    right, before = content(whole), (whole / DATABASE).read_bytes()
    found = {"corruptions": n, "refused": 0, "unchanged": 0, "accepted with wrong rows": 0, "internal errors": 0, "saved": 0}

    def tried(action: Callable[[], object]) -> bool:
        try:
            action()
        except sbt.SbtError:
            return False
        except Exception:
            found["internal errors"] += 1
        return True

    for _ in range(n):
        data = bytearray(before)
        for at, bit in zip(rng.integers(0, len(data), bits), rng.integers(0, 8, bits), strict=True):
            data[at] ^= 1 << int(bit)
        shutil.rmtree(broken, ignore_errors=True)
        broken.mkdir()
        (broken / DATABASE).write_bytes(data)
        got: list[Any] = []
        if not tried(lambda got=got: got.append(content(broken))):
            found["refused"] += 1
        elif got:
            found["unchanged" if got[0] == right else "accepted with wrong rows"] += 1
        tried(lambda: examine(broken))
        found["saved"] += not got and tried(lambda: save(broken, broken / "saved"))
    return found


def part(what: str, args: argparse.Namespace) -> dict[str, Any]:
    """Return the row of one part."""
    name, n, own = what.split()[0], args.kills, {"kind": args.executor, "workers": 2}
    executor = SERIAL if args.executor == "serial" else own
    with place() as there:
        if name in KINDS:
            found = campaigns(there, name, n, args.by, executor, args.seed)
        elif name == "dask":
            found = campaigns(there, "coverage", n, args.by, DASK, args.seed)
        elif name in COMMANDS:
            found = commands(there, name, n, args.seed)
        elif name == "storm":
            found = storm(there, 2 * n, executor)
        else:
            found = workers(there, n, args.seed, DASK if name == "dask-workers" else LOCAL)
    return found.row(what, args.seed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50, help="disturbances of each part")
    parser.add_argument("--seed", type=int, default=1)
    every = (*KINDS, *COMMANDS, "workers", "storm", "dask", "dask-workers")
    parser.add_argument("--only", nargs="+", default=every, choices=every, help="parts; default: all")
    parser.add_argument("--by", nargs="+", default=["KILL"], choices=WAYS, help="how drivers are disturbed, in turn")
    parser.add_argument("--executor", default="local", choices=("local", "serial", "dask"), help="of the campaigns")
    parser.add_argument("--table", type=Path, help="file of rows: those that are there are not made again, new ones are added")
    parser.add_argument("--corruptions", type=int, metavar="N")
    args = parser.parse_args()
    if args.corruptions is not None:
        sizes = {1: args.corruptions, 8: (3 * args.corruptions + 9) // 10}
        with place() as there:
            print(table([{"bits": bits, **corruptions(there.folder, n, bits, args.seed)} for bits, n in sizes.items()]))
        return
    wanted = list(args.only)
    if importlib.util.find_spec("distributed") is None:
        wanted = [each for each in wanted if not each.startswith("dask")]
        print("not tried: dask (pip install 'sumo-sbt[dask]')")
    rows = [json.loads(line) for line in args.table.read_text().splitlines()] if args.table and args.table.is_file() else []
    for each in wanted:
        what = f"{each} {' '.join(args.by)}" if each in (*KINDS, "dask") else each
        what = f"{what} ({args.executor})" if each in KINDS and args.executor != "local" else what
        if any(row["disturbed"] == what and row["seed"] == args.seed and row["times"] >= args.kills for row in rows):
            continue
        rows.append(part(what, args))
        if args.table:
            with args.table.open("a") as file:
                file.write(json.dumps(rows[-1]) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
