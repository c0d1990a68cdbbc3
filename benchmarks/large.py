"""What a large campaign costs the driver beside its runs: CPU time, memory, and what reads its store afterwards.

    python benchmarks/large.py --runs 1000000 --batch 100000              # coverage of an analytic testbed, on one core
    python benchmarks/large.py --runs 1000000 --batch 100000 --read      # and status, resume, report and export of its store
    python benchmarks/large.py --campaign boundary --runs 20000 --batch 2000 --workers 2

`beside the runs` is the CPU time of the driver less that of as many evaluations of the testbed, measured on 20,000 of
them. Verbs that read run as commands of their own: seconds of their clock, their own memory.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import sbt
from sbt.execution.spec import ScenarioSpec

READERS = {
    "status": ["status"], "resume": ["run"], "report": ["report"], "export csv": ["export", "--format", "csv"],
}  # fmt: skip


def evaluation(testbed: str, repeats: int = 20_000) -> float:
    """Return the CPU seconds of one run of the testbed by itself."""
    scenario = ScenarioSpec(testbed).resolve()
    values = dict.fromkeys(scenario.space.names, 0.5)
    scenario.run(values, 0)
    start = time.process_time()
    for seed in range(repeats):
        scenario.run(values, seed)
    return (time.process_time() - start) / repeats


def campaign(folder: Path, args: argparse.Namespace) -> dict[str, float]:
    """Run it; return its CPU and clock seconds and its memory (MB); every batch is told as it is chosen."""
    settings = {
        "campaign": args.campaign, "scenario": f"testbed:{args.testbed}", "budget": args.runs, "batch": args.batch,
        "initial": min(args.initial or args.batch, args.runs), "seed": args.seed, "stop": {},
        "executor": {"kind": "local", "workers": args.workers} if args.workers else {"kind": "serial"},
        "store": str(folder / "store"),
    }  # fmt: skip
    (folder / "large.yaml").write_text(json.dumps(settings))
    seen, clock, cpu = [-1], time.perf_counter(), time.process_time()

    def tell(progress: object) -> None:
        at = progress.iteration  # type: ignore[attr-defined]
        if args.verbose and at != seen[0]:
            seen[0] = at
            took = f"{time.perf_counter() - clock:.1f} s, {time.process_time() - cpu:.1f} CPU s"
            print(f"batch {at} after {progress.done} runs: {took}", flush=True)  # type: ignore[attr-defined]

    sbt.run(folder / "large.yaml", progress=tell, report=False)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return {"CPU (s)": time.process_time() - cpu, "clock (s)": time.perf_counter() - clock, "memory (MB)": memory}


def reading(folder: Path) -> None:
    """Print what the verbs take that read the store."""
    print("| verb | clock (s) | memory (MB) |\n|---|---|---|")
    for name, (verb, *options) in READERS.items():
        target = str(folder / ("large.yaml" if verb == "run" else "store"))
        command = [sys.executable, "-m", "sbt", verb, target, *options]
        start = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        failed = f" (exit code {process.returncode})" if process.returncode else ""
        print(f"| {name}{failed} | {time.perf_counter() - start:.1f} | {usage.ru_maxrss / 1e3:.0f} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--campaign", default="coverage")
    parser.add_argument("--testbed", default="hartmann6_1e-3")
    parser.add_argument("--runs", type=int, default=100_000)
    parser.add_argument("--batch", type=int, default=10_000)
    parser.add_argument("--initial", type=int, help="default: as many as a batch")
    parser.add_argument("--workers", type=int, default=0, help="0: serial")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--read", action="store_true", help="time the verbs that read the store, too")
    parser.add_argument("--verbose", action="store_true", help="tell when each batch was chosen")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = campaign(Path(folder), args)
        beside = found["CPU (s)"] - args.runs * evaluation(f"testbed:{args.testbed}")
        print("| runs | batch | CPU (s) | beside the runs (s) | clock (s) | memory (MB) |\n|---|---|---|---|---|---|")
        print(f"| {args.runs:,} | {args.batch:,} | {found['CPU (s)']:.1f} | {beside:.1f} | {found['clock (s)']:.1f} | "
              f"{found['memory (MB)']:.0f} |", flush=True)  # fmt: skip
        if args.read:
            reading(Path(folder))


if __name__ == "__main__":
    main()
