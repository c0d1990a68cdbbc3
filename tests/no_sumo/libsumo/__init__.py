"""Stands in for libsumo under `pytest --no-sumo`: a test that needs it is to be marked `sumo`."""

import os
from pathlib import Path

if log := os.environ.get("SBT_NO_SUMO_LOG"):
    with Path(log).open("a") as file:
        file.write(".")
raise ImportError("libsumo is hidden by --no-sumo: mark the test with @pytest.mark.sumo")
