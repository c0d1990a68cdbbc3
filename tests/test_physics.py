"""What tyres, drivers and pedestrians can do, over the built-in scenarios and the kinds of ego they admit."""

from __future__ import annotations

import numpy as np
import pytest
from scenario_points import sobol

from sbt.plugins import load

ONE_LANE = ("emergency_braking", "cut_in")


@pytest.mark.sumo
@pytest.mark.parametrize("name", ONE_LANE)
def test_an_ego_of_sumo_changes_lanes_only_where_asked_and_then_takes_its_time(name: str) -> None:
    lateral: dict[bool, list[float]] = {}
    for asked in (False, True):
        for model in ("Krauss", "IDM"):
            given = {"lane_change": True} if asked else {}
            scenario = load("scenarios", name).configured(ego={"kind": "sumo", "model": model, **given})
            for k, values in enumerate(sobol(scenario, 4)):
                trace = scenario.simulate(values, k)
                y = trace.actor("ego").y
                lateral.setdefault(asked, []).append(float(np.ptp(y)))
                assert np.abs(np.diff(y)).max() <= 3.5 / 3.0 * float(trace.time[1]) + 0.01, "a lane change lasts 3 s"
    assert max(lateral[False]) == 0.0
    assert max(lateral[True]) > 1.0
