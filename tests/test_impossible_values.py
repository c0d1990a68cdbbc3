"""Values of a scenario.yaml with which no run can begin are refused before any, at their place."""

from __future__ import annotations

from pathlib import Path

import pytest
from ruamel.yaml import YAML

from sbt.config.scenario_file import from_file
from sbt.errors import InputError

NET = """<net version="1.20"><edge id="road" from="a" to="b">
<lane id="road_0" index="0" speed="30" length="500" shape="0,-1.6 500,-1.6"/></edge></net>"""
ROUTES = """<routes><route id="r" edges="road"/>
<vehicle id="ego" route="r" depart="${t}" departPos="${gap}" departSpeed="5"/></routes>"""
ENDLESS = (".nan", ".inf", "-.inf", "1e400")
NO_NUMBER = ("abc", '"${"', '"${gap"', '"${gap}x"', '""', "true")


def scenario(folder: Path, key: str, value: str) -> None:
    """Read the scenario with one key changed."""
    yaml = YAML(typ="safe", pure=True)
    data = {
        "sumo": {"net": "road.net.xml", "routes": ["one.rou.xml"], "options": {}},
        "inputs": {"t": {"min": 0, "max": 5}, "gap": {"min": 5, "max": 80}}, "ego": "ego", "duration": 10,
        "insert": {"other": {"edge": "road", "position": 300, "speed": 5, "at": 0}},
        "metrics": ["collision"], "requirement": {"metric": "collision", "critical": [1, 1]},
    }  # fmt: skip
    (folder / "road.net.xml").write_text(NET)
    (folder / "one.rou.xml").write_text(ROUTES)
    at = data
    *above, last = key.split("/")
    for part in above:
        at = at[part]
    at[last] = yaml.load(value)
    with (folder / "scenario.yaml").open("w") as file:
        yaml.dump(data, file)
    from_file("scenario.yaml", folder)


TIMES = [f"sumo/options/{name}" for name in ("begin", "end", "step-length", "time-to-teleport")]
STARTS = [f"insert/other/{name}" for name in ("position", "speed", "at", "lane")]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *((key, value) for key in (*TIMES, *STARTS, "friction") for value in (*ENDLESS, *NO_NUMBER)),
        *(("sumo/options/lateral-resolution", value) for value in (*ENDLESS, '"${gap"')),
        ("sumo/options/begin", "-1"), ("sumo/options/begin", "1e23"), ("sumo/options/end", "-2"),
        ("sumo/options/step-length", "0"),
        *((f"insert/other/{key}", "-1") for key in ("speed", "at", "lane")), ("friction", '"0.5"'), ("friction", "0"),
    ],
)  # fmt: skip
def test_what_no_run_can_begin_with_is_refused_at_its_place(tmp_path, key, value):
    """Each run failed with them, `friction: "${"` with a ValueError of a line of this package."""
    with pytest.raises(InputError, match=rf"^scenario\.yaml:\d+:\d+: {key.partition('/')[0]}"):
        scenario(tmp_path, key, value)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *((key, '"${gap}"') for key in (*TIMES, *STARTS, "friction")), *((key, "1") for key in (*TIMES, "friction")),
        *((key, '"${gap}.5"') for key in (*TIMES, "friction")), ("sumo/options/end", "-1"), ("sumo/options/begin", '"0:01:30"'),
        ("sumo/options/time-to-teleport", "-1"), ("sumo/options/device.rerouting.explicit", "inf"),
        ("insert/other/speed", "max"), ("insert/other/position", "-5"), ("insert/other/position", "random_free"),
        ("insert/other/lane", "best"), ("insert/other/at", '"0:00:01"'),
        ("insert/other/at", "begin"), ("insert/other/position", "random_location"),
        ("sumo/options/time-to-teleport.remove", "true"), ("sumo/options/time-to-teleport.highways.min-speed", "19.5"),
    ],
)  # fmt: skip
def test_what_sumo_takes_is_taken(tmp_path, key, value):
    scenario(tmp_path, key, value)
