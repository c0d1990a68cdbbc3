"""What `sumo-sbt doctor` looks at: each check is ok, a warning, or broken, with what to do about it."""

from __future__ import annotations

import importlib
import os
import platform
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import sbt

__all__ = ["Check", "examine"]

_PACKAGES = ("libsumo", "torch", "gpytorch", "scikit-learn", "numpy", "scipy", "pandas", "joblib")
_MODULES = {"scikit-learn": "sklearn"}
_FREE_GB = 1.0
_COMMITS = 50
_SLOW_COMMIT_MS = 50.0
_NO_WAL = ("nfs", "nfs4", "lustre", "gpfs", "beegfs", "cifs", "smb3", "fuse.sshfs", "9p")


@dataclass(frozen=True)
class Check:
    """One check of the environment; `state` is ok, warning or broken."""

    name: str
    state: str
    detail: str
    advice: str = ""


def examine(folder: Path) -> list[Check]:
    """Return all checks; `folder` is for results and need not exist."""
    home = os.environ.get("SUMO_HOME")  # before libsumo sets it
    checks = [_python(), *(_package(name) for name in _PACKAGES)]
    checks += [_guarded(name, look) for name, look in (
        ("sumo", _sumo),
        ("SUMO_HOME", lambda: _sumo_home(home)),
        ("netconvert", _netconvert),
        ("sumo_nets", _nets),
        ("cores", _cores),
        ("cuda", _cuda),
        ("disk", lambda: _disk(folder)),
        ("sqlite", lambda: _sqlite(folder)),
    )]  # fmt: skip
    return checks


def _guarded(name: str, look: Callable[[], Check]) -> Check:
    """Return the result of a check, broken with the error where the check itself raised."""
    try:
        return look()
    except Exception as error:
        return Check(name, "broken", f"{type(error).__name__}: {error}")


def _python() -> Check:
    return Check("python", "ok", f"{platform.python_version()} on {platform.platform()}, sumo-sbt {sbt.__version__}")


def _package(name: str) -> Check:
    """Return whether a package is installed and can be imported."""
    try:
        found = version(name)
        importlib.import_module(_MODULES.get(name, name))
    except PackageNotFoundError:
        return Check(name, "broken", "not installed", f"pip install {name}")
    except Exception as error:
        return Check(name, "broken", f"cannot be imported: {type(error).__name__}: {error}", f"reinstall {name}")
    return Check(name, "ok", found)


def _sumo() -> Check:
    import libsumo

    return Check("sumo", "ok", str(libsumo.getVersion()[1]))


def _sumo_home(home: str | None) -> Check:
    """Return whether SUMO_HOME, as the user set it, belongs to the SUMO that is used."""
    if home is None:
        return Check("SUMO_HOME", "ok", f"not set; {os.environ.get('SUMO_HOME', 'none')} is used")
    advice = "unset SUMO_HOME, or point it to the SUMO of libsumo"
    if not Path(home).is_dir():
        return Check("SUMO_HOME", "warning", f"'{home}' is no folder", advice)
    sumo = shutil.which("sumo", path=str(Path(home) / "bin"))
    if sumo is None:
        return Check("SUMO_HOME", "ok", f"{home} (data only)")
    theirs, ours = _tool_version(sumo), version("libsumo")
    if not theirs.startswith(ours):
        return Check("SUMO_HOME", "warning", f"{home} is SUMO {theirs}, but libsumo is {ours}", advice)
    return Check("SUMO_HOME", "ok", f"{home}, SUMO {theirs}")


def _netconvert() -> Check:
    """Return whether networks can be built (only needed for one's own)."""
    homes = (str(Path(sys.executable).parent), os.environ.get("PATH", ""))
    home = os.environ.get("SUMO_HOME")
    path = os.pathsep.join((*homes, str(Path(home) / "bin")) if home else homes)
    tool = shutil.which("netconvert", path=path)
    if tool is None:
        advice = "only needed to build networks: pip install 'sumo-sbt[tools]'"
        return Check("netconvert", "warning", "not found", advice)
    return Check("netconvert", "ok", f"{tool}, {_tool_version(tool)}")


def _tool_version(tool: str) -> str:
    """Return the version a SUMO tool reports, such as 1.28.0."""
    done = subprocess.run([tool, "--version"], capture_output=True, text=True, timeout=20, check=False)
    words = done.stdout.split("\n", 1)[0].split()
    return words[-1].lstrip("v") if words else "unknown"


def _nets() -> Check:
    from sbt.sumo.nets import nets_folder

    folder = nets_folder()
    nets = len(list(folder.rglob("*.net.xml")))
    return Check("sumo_nets", "ok" if nets else "broken", f"{folder}, {nets} networks")


def _cores() -> Check:
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return Check("cores", "ok", f"{usable} usable of {os.cpu_count()}")


def _cuda() -> Check:
    """Return whether `device: cuda` can be used; nothing needs it."""
    import torch

    if torch.cuda.is_available():
        return Check("cuda", "ok", f"{torch.cuda.get_device_name()}, CUDA {torch.version.cuda}")
    build = "a PyTorch for the CPU only" if torch.version.cuda is None else f"a PyTorch for CUDA {torch.version.cuda}"
    return Check("cuda", "ok", f"no device, {build}: metamodels compute on the CPU")


def _existing(folder: Path) -> Path:
    """Return the folder, or the nearest one above it that exists."""
    folder = folder.resolve()
    return next(path for path in (folder, *folder.parents) if path.is_dir())


def _disk(folder: Path) -> Check:
    """Return free space and kind of the file system of the store."""
    place = _existing(folder)
    free, kind = shutil.disk_usage(place).free / 1e9, _file_system(place)
    detail = f"{place}: {free:.1f} GB free, {kind}"
    if free < _FREE_GB:
        return Check("disk", "warning", detail, "make room, or choose another folder with --store")
    if kind in _NO_WAL:
        advice = "keep stores on a local disk (--store): SQLite is slow and unsafe to share on a network file system"
        return Check("disk", "warning", detail, advice)
    return Check("disk", "ok", detail)


def _file_system(place: Path) -> str:
    """Return the kind of the file system that holds a folder, where /proc/mounts lists it."""
    mounts = Path("/proc/mounts")
    if not mounts.is_file():
        return "unknown file system"
    best = ("", "unknown file system")
    for line in mounts.read_text().splitlines():
        _, point, kind, *_ = line.split()
        inside = place == Path(point) or Path(point) in place.parents
        if inside and len(point) >= len(best[0]):
            best = (point, kind)
    return best[1]


def _sqlite(folder: Path) -> Check:
    """Return how long a durable commit takes in the folder: a running campaign makes ten of them a second."""
    place = _existing(folder)
    if not os.access(place, os.W_OK):
        return Check("sqlite", "broken", f"{place} cannot be written", "choose another folder with --store")
    with tempfile.TemporaryDirectory(dir=place, prefix=".sbt-doctor-") as scratch:
        db = sqlite3.connect(Path(scratch) / "test.sqlite", isolation_level=None)
        mode = db.execute("PRAGMA journal_mode = WAL").fetchone()[0]
        db.execute("PRAGMA synchronous = FULL")
        db.execute("CREATE TABLE t (x)")
        start = time.perf_counter()
        for k in range(_COMMITS):
            db.execute("INSERT INTO t VALUES (?)", (k,))
        took = (time.perf_counter() - start) / _COMMITS * 1e3
        db.close()
    detail = f"{sqlite3.sqlite_version}, journal {mode}, {took:.2f} ms a commit to the disk"
    if took > _SLOW_COMMIT_MS:
        return Check("sqlite", "warning", detail, "slow disk: keep the store elsewhere (--store)")
    return Check("sqlite", "ok", detail)
