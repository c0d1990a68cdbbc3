"""The shape of the package: imports go down, files stay small, nothing heavy comes in early, names exist."""

from __future__ import annotations

import ast
import importlib
import os
import re
import shutil
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "sbt"
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())

FLOORS = (
    ("sbt", "errors", "files", "seeds", "plugins", "interruption", "processes"),
    ("problem",),
    ("metrics",),
    ("sumo", "metamodels", "testbeds"),
    ("scenarios", "acquisitions", "samplers", "estimators"),
    ("execution", "store"),
    ("loop",),
    ("campaigns",),
    ("config",),
    ("report",),
    ("workflows",),
    ("benchmark", "serve", "testing"),
    ("cli",),
    ("__main__",),
)
"""Rooms from the ground up; those on one floor do not know each other unless stated in NEIGHBOURS."""
NEIGHBOURS = {"samplers": {"acquisitions"}, "plugins": {"errors", "interruption"}, "files": {"errors", "processes"}}
LATE = {
    "metrics": {"sumo"},  # reading recorded FCD needs the networks' geometry
}
"""Imports inside functions that may look up: only when they are needed."""
BELONGS = {
    "libsumo": {"sumo"}, "traci": {"sumo"}, "torch": {"metamodels"}, "gpytorch": {"metamodels"}, "sklearn": {"metamodels"},
    "joblib": {"execution"}, "distributed": {"execution"}, "sqlite3": {"store", "cli"}, "typer": {"cli"},
    "pydantic": {"config", "store"},  # reads configurations, and records of the log
}  # fmt: skip
HEAVY = ("torch", "gpytorch", "libsumo", "pandas", "scipy", "sklearn", "matplotlib", "pydantic", "joblib", "numpy")

FILES = sorted(path for path in PACKAGE.rglob("*.py") if "_nets" not in path.parts)
MODULES = [".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in FILES]


def room(module: str) -> str:
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else "sbt"


def floor(name: str) -> int:
    for level, rooms in enumerate(FLOORS):
        if name in rooms:
            return level
    raise AssertionError(f"sbt/{name} stands on no floor: put it where it belongs in FLOORS")


def imports(path: Path) -> Iterator[tuple[str, int, str]]:
    """Yield (module, line, "now" | "late" | "types") of every import of a file."""
    tree = ast.parse(path.read_text())
    kind: dict[ast.AST, str] = {}
    for node in ast.walk(tree):
        for child in ast.iter_child_nodes(node):
            kind[child] = kind.get(node, "now")
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                kind[child] = "late"
            elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
                kind[child] = "types"
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno, kind.get(node, "now")) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: imports are absolute"
            assert "*" not in {alias.name for alias in node.names}, f"{path}:{node.lineno}: no star imports"
            base = node.module or ""
            for alias in node.names:
                named = ROOT / Path(*base.split("."), alias.name)
                submodule = named.with_suffix(".py").is_file() or (named / "__init__.py").is_file()
                target = f"{base}.{alias.name}" if submodule and base.startswith("sbt") else base
                yield (target, node.lineno, kind.get(node, "now"))


def test_imports_go_down():
    wrong = []
    for path, module in zip(FILES, MODULES, strict=True):
        here = room(module)
        for target, line, when in imports(path):
            there = room(target)
            if not target.startswith("sbt") or there == here or (there == "sbt" and target == "sbt"):
                continue
            allowed = floor(there) < floor(here) or there in NEIGHBOURS.get(here, set())
            if when != "now":
                allowed = allowed or there in LATE.get(here, set()) or when == "types" or floor(there) <= floor(here)
            if not allowed:
                wrong.append(f"{path.relative_to(ROOT)}:{line}: {here} imports {target} ({when})")
    assert wrong == []


def test_the_root_is_small():
    assert len(list(PACKAGE.glob("*.py"))) <= 10


def test_rooms_know_few_rooms():
    """Rooms: folders, loose modules at the root, benchmarks/. An edge: a room that one of its files imports, now or late."""
    files = [*zip(FILES, map(room, MODULES), strict=True), *((path, "benchmarks") for path in (ROOT / "benchmarks").glob("*.py"))]
    edges = {
        (here, room(target)) for path, here in files for target, _, when in imports(path)
        if target.split(".")[0] == "sbt" and when != "types" and room(target) != here
    }  # fmt: skip
    assert len(edges) <= 150, "\n".join(f"{here} -> {there}" for here, there in sorted(edges))


def test_no_import_goes_round():
    """Modules as they are loaded: what is imported at once must be free of cycles."""
    known = set(MODULES)
    graph = {
        module: {t for t, _, when in imports(path) if when == "now" and t in known and t != module}
        for path, module in zip(FILES, MODULES, strict=True)
    }
    done: set[str] = set()

    def visit(module: str, way: tuple[str, ...]) -> None:
        assert module not in way, " -> ".join((*way[way.index(module) :], module))
        if module not in done:
            for target in sorted(graph[module]):
                visit(target, (*way, module))
            done.add(module)

    for module in sorted(graph):
        visit(module, ())


@pytest.mark.parametrize("library", BELONGS)
def test_each_library_has_its_room(library):
    """The doctor, who looks at all of them, aside."""
    users = {
        room(module) for path, module in zip(FILES, MODULES, strict=True) if module != "sbt.cli.doctor"
        for target, _, _ in imports(path) if target.split(".")[0] == library
    }  # fmt: skip
    assert users <= BELONGS[library], f"{library} belongs to {BELONGS[library]}"


def test_files_are_short():
    long = {str(p.relative_to(ROOT)): n for p in FILES if (n := len(p.read_text().splitlines())) > 400}
    assert long == {}


@pytest.mark.parametrize("module", [m for m in MODULES if m != "sbt.__main__"])
def test_public_names_exist_and_are_described(module):
    loaded = importlib.import_module(module)
    assert (loaded.__doc__ or "").strip(), f"{module} must say what it is for"
    offered = getattr(loaded, "__all__", None)
    tree = ast.parse(Path(str(loaded.__file__)).read_text())
    own = [n.name for n in tree.body if isinstance(n, ast.FunctionDef | ast.ClassDef) and not n.name.startswith("_")]
    if offered is None:
        assert own == [], f"{module} defines {own} but has no __all__"
        return
    assert len(set(offered)) == len(offered)
    assert [name for name in offered if not hasattr(loaded, name)] == []
    for name in set(offered) & set(own):
        assert (getattr(loaded, name).__doc__ or "").strip(), f"{module}.{name} must be described"


def exists(dotted: str) -> bool:
    """Return whether `sbt.module.name` or `Class.name` of this package is there."""
    names = dotted.split(".")
    if names[0] == "sbt":
        module = max((m for m in MODULES if dotted == m or dotted.startswith(m + ".")), key=len)
        owners, rest = [importlib.import_module(module)], dotted.removeprefix(module).split(".")[1:]
    else:
        loaded = [importlib.import_module(m) for m in MODULES if m != "sbt.__main__"]
        owners, rest = [vars(m)[names[0]] for m in loaded if names[0] in vars(m)], names[1:]
    return not owners or not rest or any(hasattr(o, rest[0]) or rest[0] in getattr(o, "__annotations__", {}) for o in owners)


def test_what_docstrings_name_exists():
    """`sbt.module.name` and `Class.name` in backticks."""
    gone = []
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                named = re.findall(r"`((?:sbt|[A-Z]\w*[a-z]\w*)(?:\.\w+)+)(?:\(\))?`", node.value)
                gone += [f"{path.relative_to(ROOT)}:{node.lineno}: {name}" for name in named if not exists(name)]
    assert gone == []


def test_randomness_begins_in_seeds_only():
    pattern = re.compile(r"np\.random\.(?!Generator|PCG64|SeedSequence)\w+|(?<!\w)random\.seed|torch\.manual_seed|time\.time\(\)")
    found = [
        f"{path.relative_to(ROOT)}:{k}: {line.strip()}"
        for path in FILES for k, line in enumerate(path.read_text().splitlines(), 1)
        if pattern.search(line.partition("#")[0]) and "fork_rng" not in path.read_text()
    ]  # fmt: skip
    assert found == []


def loaded_by(code: str) -> set[str]:
    done = subprocess.run(
        [sys.executable, "-c", f"{code}\nimport sys\nprint(*sys.modules)"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return set(done.stdout.split())


def test_nothing_heavy_is_loaded_early():
    assert loaded_by("import sbt") & set(HEAVY) == set()
    assert loaded_by("import sbt.cli") & set(HEAVY) == set()
    later = {"torch", "gpytorch", "libsumo", "pandas", "sklearn", "matplotlib"}
    loop = "sbt.workflows.running, sbt.workflows.front, sbt.config.assemble, sbt.store.database, sbt.execution.local"
    assert loaded_by(f"import {loop}") & later == set()
    assert loaded_by("import sbt.execution.worker, sbt.sumo.simulation") & {*later, "scipy.stats"} == set(), "workers start often"
    method = "sbt.acquisitions, sbt.samplers.roi, sbt.testing, sbt.metamodels.base, sbt.metamodels.scores"
    assert loaded_by(f"import {method}") & later == set()


def entry_points() -> list[tuple[str, str, str]]:
    groups = {**PYPROJECT["project"]["entry-points"], "scripts": PYPROJECT["project"]["scripts"]}
    return [(group, name, target) for group, entries in groups.items() for name, target in entries.items()]


@pytest.mark.parametrize(("group", "name", "target"), entry_points(), ids=lambda value: value)
def test_entry_points_exist(group, name, target):
    module, _, attribute = target.partition(":")
    found = getattr(importlib.import_module(module), attribute)
    if group == "sbt.campaigns":
        assert found.description
        assert callable(found.recipe)
        return
    assert callable(found) or group in ("sbt.scenarios", "sbt.metrics")
    if group in ("sbt.scenarios", "sbt.metrics"):
        assert found.name == name


def test_what_is_installed_is_what_the_project_says():
    try:
        installed = {(e.group, e.name, e.value) for e in distribution("sumo-sbt").entry_points}
    except PackageNotFoundError:
        pytest.skip("sumo-sbt is not installed")
    declared = {(("console_scripts" if g == "scripts" else g), n, t) for g, n, t in entry_points()}
    assert installed == declared, "install the package again: pip install --editable ."


def netconvert() -> str | None:
    found = shutil.which("netconvert")
    if found is not None:
        return found
    try:
        import sumo
    except ImportError:
        return None
    beside = Path(str(sumo.SUMO_HOME)) / "bin" / "netconvert"
    return str(beside) if beside.is_file() else None


def essence(path: Path) -> object:
    """A network without its comment (date, version of netconvert) as nested tuples."""

    def tree(node: ET.Element) -> object:
        return node.tag, tuple(sorted(node.attrib.items())), tuple(tree(child) for child in node)

    return tree(ET.parse(path).getroot())


def test_networks_are_built_from_their_sources(tmp_path):
    program = netconvert()
    if program is None:
        pytest.skip("netconvert is not installed (pip install 'sumo-sbt[tools]')")
    environment = {k: v for k, v in os.environ.items() if k != "SUMO_HOME"}
    environment["PATH"] = os.pathsep.join([str(Path(program).parent), environment["PATH"]])
    subprocess.run([ROOT / "scripts" / "build-nets", tmp_path], check=True, capture_output=True, env=environment)
    stored = sorted(path.relative_to(ROOT / "sumo_nets") for path in (ROOT / "sumo_nets").rglob("*.net.xml"))
    assert stored
    for net in stored:
        assert essence(tmp_path / net) == essence(ROOT / "sumo_nets" / net), f"{net}: run scripts/build-nets"
