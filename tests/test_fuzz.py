"""A small share of what `benchmarks/fuzz.py` tries."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[1] / "benchmarks" / "fuzz.py"


@pytest.mark.slow
@pytest.mark.sumo
def test_wrong_configurations_and_scenario_files_are_errors_in_words():
    done = subprocess.run(
        [sys.executable, SCRIPT, "--configurations", "25", "--scenarios", "15", "--seed", "5"], capture_output=True, text=True,
        timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    names, _, *counts = ([cell.strip() for cell in line.strip("|").split("|")] for line in done.stdout.splitlines()[-4:])
    for row in counts:
        found = dict(zip(names, row, strict=True))
        assert found["internal errors"] == "0"
        assert int(found["cases"]) == int(found["run"]) + int(found["refused"]) + int(found["made a row by local"])
