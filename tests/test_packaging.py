"""The wheel carries all that a campaign needs: networks, the report's template, the entry points."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

pytest.importorskip("hatchling", reason="hatchling builds the wheel")
ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)], cwd=ROOT, check=True, capture_output=True
    )
    (built,) = folder.glob("*.whl")
    return built


def test_wheel_holds_everything_that_is_not_python(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    nets = {f"sbt/_nets/{p.relative_to(ROOT / 'sumo_nets')}" for p in (ROOT / "sumo_nets").rglob("*.net.xml")}
    assert nets
    assert nets <= names
    assert "sbt/report/template.html" in names
    assert not [n for n in names if n.startswith(("tests/", "configs/", "runs/", "sumo_nets/"))]


@pytest.mark.sumo
def test_wheel_runs_away_from_the_checkout(wheel: Path, tmp_path: Path) -> None:
    unpacked = tmp_path / "site"
    zipfile.ZipFile(wheel).extractall(unpacked)
    (tmp_path / "c.yaml").write_text("campaign: coverage\nscenario: cut_in\nbudget: 12\nexecutor: {kind: serial}\n")
    code = (
        "import sbt, sys; from sbt.sumo.nets import nets_folder; print(sbt.__file__); print(nets_folder());"
        "sys.argv = ['sumo-sbt', 'run', 'c.yaml']; from sbt.cli import main; main()"
    )
    env = {**os.environ, "PYTHONPATH": str(unpacked)}
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    package, nets, *_ = done.stdout.splitlines()
    assert Path(package).is_relative_to(unpacked)
    assert Path(nets).is_relative_to(unpacked)
    assert (tmp_path / "runs" / "coverage_cut_in" / "report.html").is_file()
