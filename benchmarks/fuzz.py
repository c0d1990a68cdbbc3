"""Configurations and scenario files that are wrong in ways nobody thought of: each is an error in words, or runs.

    python benchmarks/fuzz.py [--configurations 2000] [--scenarios 500] [--seed 1] [--part 1/1] [--show internal]

The configurations are those of `configs/` and of the documentation, the scenario files those of the tutorials with
their SUMO files; in each some keys are dropped, renamed, doubled, swapped or given other values, lines are cut and
bytes exchanged. What is accepted is run, with a budget of a few runs. An internal error is everything raised that is no
`SbtError`: the command line would print a traceback. Each case runs in a child of this process, so that one that
hangs or kills its process (SUMO's own faults, endless loops of a script) is found; it is then run by `local` as in a
campaign with defaults, which makes rows of both: the column `made a row by local`.
"""

from __future__ import annotations

import argparse
import inspect
import io
import json
import os
import re
import resource
import select
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from fuzz_values import DECORATIONS, LINES, NUMBERS, OTHERS, RANGES, SECTIONS, TEXTS
from ruamel.yaml import YAML

import sbt
from sbt.config.load import parse
from sbt.config.load import schema as configuration_schema
from sbt.config.scenario_model import schema as scenario_schema
from sbt.errors import SbtError
from sbt.seeds import stream
from sbt.workflows.running import run_study
from sbt.workflows.study import Study

ROOT = Path(__file__).resolve().parents[1]
LIMIT = 10.0
"""Longest time of a case (s of CPU, which a crowded machine does not change)."""
STOP = 120.0
"""After which a child is killed (s of the clock)."""
_BLOCK = re.compile(r"^```(\w+)(?: (\S+))?\n(.*?)^```", re.MULTILINE | re.DOTALL)
LOCAL = "{kind: local, workers: 1, timeout: 4}"


@dataclass(frozen=True)
class Seed:
    """A file that is right: its text, and the folder with the files that it names, which may be none."""

    name: str
    text: str
    files: tuple[tuple[str, bytes], ...] = ()


def blocks(page: Path) -> list[tuple[str, str, str]]:
    """Return language, name and text of the blocks of a page."""
    return [(match[1], match[2] or "", match[3]) for match in _BLOCK.finditer(page.read_text())]


def configurations() -> list[Seed]:
    """Return the campaigns of `configs/` and of the documentation that need no other file."""
    texts = {path.name: path.read_text() for path in sorted((ROOT / "configs").glob("*.yaml"))}
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        texts |= {f"{page.name}:{k}": text for k, (kind, _, text) in enumerate(blocks(page)) if kind == "yaml"}
    found = [Seed(name, text) for name, text in texts.items() if re.search(r"^campaign: \w+$", text, re.MULTILINE)]
    return [seed for seed in found if not re.search(r"scenario: \S+\.(yaml|py)|store: runs/earlier|file\.py", seed.text)]


def scenarios() -> list[Seed]:
    """Return the scenario files of the tutorials, each with the files beside it."""
    found = []
    for page in sorted((ROOT / "docs" / "tutorials").glob("*.md")):
        named = [(name, text) for _, name, text in blocks(page) if name and not name.startswith("+")]
        files = tuple((name, text.encode()) for name, text in named)
        for name, text in named:
            if name.endswith(".yaml") and not text.startswith("campaign") and "opendrive" not in page.name:
                found.append(Seed(f"{page.name}:{name}", text, files))
    return found


def paths_in(data: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the paths of all values in nested data, but its own."""
    found, todo = list[tuple[Any, ...]](), [(path, data)]
    while todo and len(found) < 5000:  # without recursion: some data are deeper than Python's stack
        here, value = todo.pop()
        inner = value.items() if isinstance(value, dict) else enumerate(value[:50]) if isinstance(value, list) else ()
        below = [((*here, key), item) for key, item in inner if len(here) < 40]
        found += [each for each, _ in below]
        todo += below
    return found


def value_at(data: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        data = data[key]
    return data


def any_value(rng: np.random.Generator, data: Any) -> Any:
    """Return an odd value, or one from elsewhere in the data."""
    pool = (NUMBERS, TEXTS, OTHERS)[int(rng.integers(3))]
    there = paths_in(data)
    if there and rng.random() < 0.2:
        return value_at(data, there[int(rng.integers(len(there)))])
    if rng.random() < 0.02:
        deep: Any = 1
        for _ in range(int(rng.choice([30, 300, 3000]))):
            deep = [deep]
        return deep
    return pool[int(rng.integers(len(pool)))]


def changed(rng: np.random.Generator, data: Any, known: Sequence[str]) -> None:
    """Change one thing in nested data."""
    there = paths_in(data)
    if not there:
        return
    path = there[int(rng.integers(len(there)))]
    parent, key, kind = value_at(data, path[:-1]), path[-1], rng.random()
    if kind < 0.45:
        parent[key] = any_value(rng, data)
    elif kind < 0.55:
        del parent[key]
    elif kind < 0.8 and isinstance(parent, dict):  # a key of any configuration, or one that looks like it
        name = known[int(rng.integers(len(known)))]
        parent[name if rng.random() < 0.8 else str(key)[:-1] + "x"] = any_value(rng, data)
    elif isinstance(parent, list):
        parent.insert(int(key), any_value(rng, data))
    elif isinstance(value := parent[key], int | float) and not isinstance(value, bool):
        factor = float(rng.choice([-1.0, 0.0, 1e-12, 1e3, 1e9, 1e150]))
        parent[key] = value * factor if abs(value) < 1e150 else -value
    else:
        parent[key] = [parent[key], any_value(rng, data)]


def spoilt(rng: np.random.Generator, data: bytes) -> bytes:
    """Return bytes with one place of them cut, doubled, exchanged or overwritten."""
    lines, at = data.split(b"\n"), int(rng.integers(max(len(data), 1)))
    match int(rng.integers(6)):
        case 0:
            return data[:at]
        case 1:
            return data[:at] + bytes(rng.integers(0, 256, int(rng.integers(1, 4)), dtype=np.uint8)) + data[at + 1 :]
        case 2:
            k = int(rng.integers(len(lines)))
            return b"\n".join([*lines[: k + 1], *lines[k:]])
        case 3:
            k = int(rng.integers(len(lines)))
            return b"\n".join([*lines[:k], *lines[k + 1 :]])
        case 4:
            numbers = list(re.finditer(rb"-?\d+(\.\d+)?", data))
            if not numbers:
                return data
            one = numbers[int(rng.integers(len(numbers)))]
            new = str(NUMBERS[int(rng.integers(len(NUMBERS)))]).encode()
            return data[: one.start()] + new + data[one.end() :]
    words = list(re.finditer(rb"\"[^\"]*\"|[\w.]+", data))
    if not words:
        return data
    one, other = (words[int(rng.integers(len(words)))] for _ in range(2))
    return data[: one.start()] + other.group() + data[one.end() :]


def decorated(rng: np.random.Generator, text: str) -> str:
    """Return YAML with a value in it, or a line, that YAML itself makes something odd of."""
    lines = text.splitlines()
    k = int(rng.integers(len(lines)))
    key, colon, _ = lines[k].partition(": ")
    if colon and rng.random() < 0.7:
        lines[k] = f"{key}: {DECORATIONS[int(rng.integers(len(DECORATIONS)))]}"
    else:
        lines.insert(k, LINES[int(rng.integers(len(LINES)))])
    ending = str(rng.choice(["\n", "\n", "\n", "\r\n", "\r"]))
    return ending.join(lines) + ending


def catalogue() -> set[str]:
    """Return all keys that a campaign or a scenario may have, and the settings of metamodels."""
    found, todo = set[str](), [configuration_schema(), scenario_schema()]
    while todo:
        value = todo.pop()
        if isinstance(value, dict):
            found |= set(value.get("properties", ()))
        todo += value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    for kind in (getattr(sbt.metamodels, name) for name in dir(sbt.metamodels)):
        found |= set(inspect.signature(kind).parameters)
    return found


def nearly_right(rng: np.random.Generator, value: Any) -> None:
    """Give some keys of a campaign, or a range of a scenario, values that are right, or nearly so."""
    inputs = value.setdefault("inputs", {}) if isinstance(value, dict) else {}
    if rng.random() < 0.5 or "campaign" not in value:
        name = str(rng.choice([*inputs, "d_t", "d_v"])) if "campaign" in value else str(rng.choice([*inputs]))
        inputs[name] = {**inputs.get(name, {}), **RANGES[int(rng.integers(len(RANGES)))]}
    for _ in range(int(rng.integers(0, 3)) + ("campaign" in value)):
        key = str(rng.choice([*SECTIONS]))
        if "campaign" in value or key in ("requirement", "constraints", "features", "metrics", "correlation"):
            value[key] = SECTIONS[key][int(rng.integers(len(SECTIONS[key])))]


def mutated(rng: np.random.Generator, seed: Seed, known: Sequence[str]) -> bytes:
    """Return the text of a seed with one to four changes."""
    if rng.random() < 0.25:
        data = seed.text.encode()
        for _ in range(int(rng.integers(1, 4))):
            data = spoilt(rng, data)
        return data
    if rng.random() < 0.2:
        text = seed.text
        for _ in range(int(rng.integers(1, 3))):
            text = decorated(rng, text)
        return text.encode("utf-8", "surrogatepass")
    value = YAML(typ="safe", pure=True).load(seed.text)
    if rng.random() < 0.6:
        nearly_right(rng, value)
        return json.dumps(value).encode()
    for _ in range(int(rng.choice([1, 1, 2, 4]))):
        changed(rng, value, known)
    stream_, yaml = io.StringIO(), YAML(typ="safe", pure=True)
    try:
        yaml.dump(value, stream_)
        return stream_.getvalue().encode("utf-8", "surrogatepass")
    except RecursionError:
        return b"a: " + b"[" * 10_000


def small(text: str, scenario: Path | None, folder: Path, executor: str) -> Study:
    """Return the study of a configuration, made so small that it runs in a second."""
    if scenario is not None:
        text = f"campaign: coverage\nscenario: {json.dumps(str(scenario))}\nbudget: 2\n"
    path = folder / "campaign.yaml"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    loaded = Study.from_file(path).loaded  # all as it is given
    config = loaded.config
    few = min(config.budget, 2 if scenario is not None else 14)
    changes = {
        "executor": executor, "budget": few, "initial": min(config.initial, 6), "batch": min(config.batch, 4),
        "validation.reference": min(config.validation.reference, 3), "store": json.dumps(str(folder / "store")),
    }  # fmt: skip
    if config.metamodel is not None and config.metamodel.kind not in ("gp", "et"):
        changes |= {"metamodel": "{kind: gp, max_epochs: 5}"}
    overrides = [f"{key}={value}" for key, value in changes.items()]
    return Study(parse(path.read_text(encoding="utf-8-sig"), overrides, name=str(path), folder=folder))


def tried(action: Callable[[], object]) -> tuple[str, str]:
    """Return what came of an action: ok, refused, or internal with where it was raised."""
    try:
        action()
    except SbtError as error:
        text = str(error)
        return ("refused", text) if text.strip() and "internal error" not in text else ("internal", f"no words: {error!r}")
    except BaseException as error:
        where = traceback.format_exc().splitlines()
        return "internal", f"{type(error).__name__}: {error}"[:300] + "\n" + "\n".join(where[-14:])
    return "ok", ""


def case(
    kind: str, seeds: Sequence[Seed], known: Sequence[str], number: int, seed: int, folder: Path, executor: str
) -> tuple[str, str]:
    """Make one case, and return what came of it."""
    rng = stream(seed, f"{kind} {number}")
    chosen = seeds[int(rng.integers(len(seeds)))]
    scenario: Path | None = None
    if kind == "configurations":
        text = mutated(rng, chosen, known).decode("utf-8", "surrogateescape")
        (folder / "given.yaml").write_bytes(text.encode("utf-8", "surrogateescape"))
    else:
        files, which = dict(chosen.files), rng.random()
        name = chosen.name.partition(":")[2]
        xml = [key for key in files if not key.endswith((".yaml", ".csv"))]
        if which < 0.5 or not xml:
            files[name] = mutated(rng, chosen, known)
        else:
            other = xml[int(rng.integers(len(xml)))]
            for _ in range(int(rng.integers(1, 4))):
                files[other] = spoilt(rng, files[other])
        for key, content in files.items():
            (folder / key).parent.mkdir(parents=True, exist_ok=True)
            (folder / key).write_bytes(content)
        scenario, text = folder / name, ""

    def action() -> None:
        study = small(text, scenario, folder, executor)
        run_study(study, report=kind == "configurations" and number % 3 == 0)

    return tried(action)


def children(
    kind: str, numbers: Sequence[int], seeds: Sequence[Seed], seed: int, executor: str = "{kind: serial}"
) -> list[tuple[int, str, str, float]]:
    """Try all cases in children of this process; return number, what came of it, message and seconds of each."""
    written = {str(path[-1]) for each in seeds for path in paths_in(YAML(typ="safe", pure=True).load(each.text))}
    known = sorted(written | catalogue())
    todo, found = list(numbers), []
    while todo:
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(reading)
            _work(kind, todo, seeds, known, seed, writing, executor)
        os.close(writing)
        with io.FileIO(reading) as pipe:
            buffer = b""
            while todo:
                ready, _, _ = select.select([pipe], [], [], STOP)
                part = pipe.read(1 << 20) if ready else b""
                if not part:
                    break
                buffer += part
                *lines, buffer = buffer.split(b"\n")
                for line in lines:
                    number, outcome, message, seconds = json.loads(line)
                    found.append((number, outcome, message, seconds))
                    show(kind, found[-1])
                    todo.remove(number)
            if todo and not ready:
                os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        if todo:
            died = os.waitstatus_to_exitcode(status)
            hung = "hung" if died in (-signal.SIGKILL, -signal.SIGXCPU) else "died"
            lost, message, seconds = todo.pop(0), f"the process ended with {died}", STOP if hung == "hung" else 0.0
            if executor == LOCAL:
                found.append((lost, hung, message, seconds))
            else:
                ((_, outcome, message, seconds),) = children(kind, [lost], seeds, seed, LOCAL)
                found.append((lost, "contained" if outcome in ("ok", "refused") else outcome, message, seconds))
                show(kind, found[-1])
    return found


def _work(
    kind: str, todo: Sequence[int], seeds: Sequence[Seed], known: Sequence[str], seed: int, pipe: int, executor: str
) -> None:
    """In a child: try the cases, and tell of each."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(nowhere, descriptor)
    warnings.simplefilter("ignore")
    for number in todo:
        folder = Path(tempfile.mkdtemp(prefix=f"sbt-fuzz-{os.getpid()}-"))
        os.chdir(folder)
        begin = _cpu()
        limit = int(begin) + 60
        resource.setrlimit(resource.RLIMIT_CPU, (limit, resource.RLIM_INFINITY))  # ends a loop
        outcome, message = case(kind, seeds, known, number, seed, folder, executor)
        line = json.dumps([number, outcome, message[-3000:], round(_cpu() - begin, 3)])
        os.write(pipe, line.encode() + b"\n")
        os.chdir("/")
        shutil.rmtree(folder, ignore_errors=True)
    os._exit(0)


def _cpu() -> float:
    """Return the seconds of CPU of this process and its children."""
    here, below = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    return here.ru_utime + here.ru_stime + below.ru_utime + below.ru_stime


def show(kind: str, one: tuple[int, str, str, float]) -> None:
    """Print a case that must not be."""
    number, outcome, message, seconds = one
    if outcome in ("internal", "died", "hung") or seconds > LIMIT:
        print(f"--- {kind} {number}: {outcome}, {seconds:.1f} s\n{message}", flush=True)


def summary(kind: str, found: Sequence[tuple[int, str, str, float]]) -> dict[str, Any]:
    """Return the row of the table."""
    counts = Counter(outcome for _, outcome, _, _ in found)
    slow = [number for number, _, _, seconds in found if seconds > LIMIT]
    return {
        "files": kind, "cases": len(found), "run": counts["ok"], "refused": counts["refused"],
        "internal errors": counts["internal"],
        "made a row by local": counts["contained"],
        "killed their process": counts["died"], "hung": counts["hung"], f"over {LIMIT:g} s of CPU": len(slow),
        "longest (s of CPU)": round(max((s for *_, s in found), default=0.0), 1),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--configurations", type=int, default=2000)
    parser.add_argument("--scenarios", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--part", default="1/1", help="only every n-th case, beginning with the i-th: i/n")
    parser.add_argument("--case", type=int, help="only this one, shown")
    args = parser.parse_args()
    part, parts = map(int, args.part.split("/"))
    rows = []
    for kind, n, seeds in (("configurations", args.configurations, configurations()), ("scenarios", args.scenarios, scenarios())):
        numbers = list(range(part - 1, n, parts)) if args.case is None else [args.case] if n else []
        found = children(kind, numbers, seeds, args.seed)
        rows.append(summary(kind, found))
    lines = [list(rows[0]), ["---"] * len(rows[0]), *([str(value) for value in row.values()] for row in rows)]
    print("\n".join(f"| {' | '.join(line)} |" for line in lines))
    sys.exit(any(row["internal errors"] or row["hung"] or row["killed their process"] for row in rows))


if __name__ == "__main__":
    main()
