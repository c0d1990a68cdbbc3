"""What kills and damage do to a campaign: what is left behind, and whether its rows are those of one that was left alone.

    python benchmarks/faults.py [--kills 50] [--executor local] [--signal KILL] [--seed 1]
    python benchmarks/faults.py --resumed 50        # campaigns that are killed again and again until they end
    python benchmarks/faults.py --corruptions 200   # single bits, and 60 times eight bits, of a finished store

Kills: a campaign of cut_in is started again and again, and its driver is killed at a random moment of 0.2 to 3 s.
Processes are found by a variable of their environment, five seconds after the last kill; folders are what is
in TMPDIR then, and after one more campaign, which runs to its end and removes what the killed ones left.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import sbt
from sbt.seeds import stream
from sbt.store.database import DATABASE, Store
from sbt.store.rescue import examine, save

TAG = "SBT_FAULTS_TAG"
WAIT = 5.0
"""Seconds after which nothing of a killed campaign may run."""
KINDS = ("coverage", "boundary", "falsification", "estimation")


def tagged(value: str) -> list[int]:
    """Return the living processes with this value of the variable in their environment, but not this one."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            wanted = f"{TAG}={value}".encode() in (folder / "environ").read_bytes().split(b"\0")
            running = (folder / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
        except OSError:
            continue
        if wanted and running and int(folder.name) != os.getpid():
            found.append(int(folder.name))
    return found


def start(folder: Path, name: str, tag: str, executor: str, budget: int) -> subprocess.Popen[bytes]:
    """Start a campaign with two workers and a store of its own."""
    config = folder / f"{name}.yaml"
    config.write_text(json.dumps({
        "campaign": "coverage", "scenario": "cut_in", "budget": budget, "batch": budget,
        "executor": {"kind": executor, "workers": 2}, "store": str(folder / name),
    }))  # fmt: skip
    temporary = folder / "tmp"
    temporary.mkdir(exist_ok=True)
    return subprocess.Popen(
        [sys.executable, "-m", "sbt", "run", str(config), "--quiet"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        env={**os.environ, TAG: tag, "TMPDIR": str(temporary)},
    )  # fmt: skip


def kills(folder: Path, n: int, executor: str, number: int, seed: int) -> dict[str, int | float]:
    """Kill n campaigns; return how many there were, and what was left."""
    tag, rng, finished = uuid.uuid4().hex, stream(seed, "moments of kills"), 0
    for k in range(n):
        driver = start(folder, f"killed-{k}", tag, executor, 100_000)
        time.sleep(float(rng.uniform(0.2, 3.0)))
        finished += driver.poll() is not None
        driver.send_signal(number)
        driver.wait()
    killed = time.monotonic()
    gone = 0.0
    while (left := tagged(tag)) and (gone := time.monotonic() - killed) < WAIT:
        time.sleep(0.05)
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    folders = len(list((folder / "tmp").iterdir()))
    last = start(folder, "last", tag, executor, 60).wait()
    return {
        "kills": n, "ended before": finished, "processes left": len(left), "seconds until none": round(gone, 2),
        "folders left": folders, "folders after one more campaign": len(list((folder / "tmp").iterdir())), "its exit code": last,
    }  # fmt: skip


def resumed(folder: Path, n: int, seed: int) -> dict[str, dict[str, int]]:
    """Kill campaigns of every kind at random moments, run each again until n kills are made, and compare with ones left alone."""
    rng, found = stream(seed, "moments of kills"), {}
    for kind in KINDS:
        data = {"campaign": kind, "scenario": "testbed:four_branch_7", "budget": 150, "batch": 10, "metamodel": {"kind": "gp"}}
        if kind == "coverage":
            del data["metamodel"]
        for name, more in (("alone", {"kind": "serial"}), ("killed", {"kind": "local", "workers": 2})):
            store = str(folder / kind / name)
            (folder / f"{kind}-{name}.yaml").write_text(json.dumps({**data, "executor": more, "store": store}))
        begin = time.monotonic()
        run, quiet = [sys.executable, "-m", "sbt", "run"], subprocess.DEVNULL
        subprocess.run([*run, folder / f"{kind}-alone.yaml", "--quiet"], check=True, stdout=quiet, stderr=quiet)
        whole, kills, equal, campaigns = time.monotonic() - begin, 0, 0, 0
        while kills < n:
            shutil.rmtree(folder / kind / "killed", ignore_errors=True)
            code: int | None = None
            while code is None:
                driver = subprocess.Popen([*run, folder / f"{kind}-killed.yaml", "--quiet"], stdout=quiet, stderr=quiet)
                try:
                    code = driver.wait(float(rng.uniform(0.2, 1.2 * whole)) if kills < n else None)
                except subprocess.TimeoutExpired:
                    driver.kill()
                    driver.wait()
                    kills += 1
            campaigns += 1
            equal += code == 0 and _content(folder / kind / "killed") == _content(folder / kind / "alone")
        found[kind] = {"kills": kills, "campaigns": campaigns, "equal": equal}
    return found


def _content(folder: Path) -> Any:
    """Return what a store must hold, however it came about."""
    with Store.read(folder) as store:
        rows = [dataclasses.replace(record, seconds=0.0) for record in store.history().records]
        conclusion = (store.conclusion or {}).get("conclusion")
        return rows, store.iterations(), conclusion


def corruptions(folder: Path, n: int, bits: int, seed: int) -> dict[str, int]:
    """Flip bits of a finished store n times, read it, and save what is whole; counts of what came of it."""
    rng, whole, broken = stream(seed, f"{bits} bits"), folder / "whole", folder / "broken"
    if not whole.exists():
        sbt.run(
            campaign="falsification", scenario="testbed:four_branch_7", budget=60, batch=10, metamodel="gp", executor="serial",
            store=whole, report=False,
        )  # fmt: skip
    right, content = _content(whole), (whole / DATABASE).read_bytes()
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
        data = bytearray(content)
        for at, bit in zip(rng.integers(0, len(data), bits), rng.integers(0, 8, bits), strict=True):
            data[at] ^= 1 << int(bit)
        shutil.rmtree(broken, ignore_errors=True)
        broken.mkdir()
        (broken / DATABASE).write_bytes(data)
        got: list[Any] = []
        if not tried(lambda got=got: got.append(_content(broken))):
            found["refused"] += 1
        elif got:
            found["unchanged" if got[0] == right else "accepted with wrong rows"] += 1
        tried(lambda: examine(broken))
        found["saved"] += not got and tried(lambda: save(broken, broken / "saved"))
    return found


def table(rows: list[dict[str, Any]]) -> str:
    """Return rows of equal keys as a table."""
    lines = [list(rows[0]), ["---"] * len(rows[0]), *([str(value) for value in row.values()] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--executor", default="local", choices=("local", "serial", "dask"))
    parser.add_argument("--signal", default="KILL", choices=("KILL", "TERM", "HUP", "QUIT", "INT"))
    parser.add_argument("--resumed", type=int, metavar="KILLS")
    parser.add_argument("--corruptions", type=int, metavar="N")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    if args.executor == "dask" and importlib.util.find_spec("distributed") is None:
        parser.error("--executor dask needs distributed: pip install 'sumo-sbt[dask]'")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if args.resumed is not None:
            print(table([{"campaign": kind, **counts} for kind, counts in resumed(folder, args.resumed, args.seed).items()]))
        elif args.corruptions is not None:
            sizes = {1: args.corruptions, 8: (3 * args.corruptions + 9) // 10}
            print(table([{"bits": bits, **corruptions(folder, n, bits, args.seed)} for bits, n in sizes.items()]))
        else:
            found = kills(folder, args.kills, args.executor, signal.Signals[f"SIG{args.signal}"], args.seed)
            print(f"executor {args.executor}, SIG{args.signal}, at a random moment of 0.2 to 3 s\n\n{table([found])}")


if __name__ == "__main__":
    main()
