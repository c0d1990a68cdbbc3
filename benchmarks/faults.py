"""What a killed campaign leaves behind: processes and temporary folders.

    python benchmarks/faults.py [--kills 50] [--executor local] [--signal KILL] [--seed 1]

A campaign of cut_in is started again and again, and its driver is killed at a random moment of 0.2 to 3 s.
Processes are found by a variable of their environment, five seconds after the last kill; folders are what is
in TMPDIR then, and after one more campaign, which runs to its end and removes what the killed ones left.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from pathlib import Path

from sbt.seeds import stream

TAG = "SBT_FAULTS_TAG"
WAIT = 5.0
"""Seconds after which nothing of a killed campaign may run."""


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--executor", default="local", choices=("local", "serial", "dask"))
    parser.add_argument("--signal", default="KILL", choices=("KILL", "TERM", "HUP", "QUIT", "INT"))
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = kills(Path(folder), args.kills, args.executor, signal.Signals[f"SIG{args.signal}"], args.seed)
    print(f"executor {args.executor}, SIG{args.signal}, at a random moment of 0.2 to 3 s\n")
    print("| " + " | ".join(found) + " |\n|" + "---|" * len(found) + "\n| " + " | ".join(map(str, found.values())) + " |")


if __name__ == "__main__":
    main()
