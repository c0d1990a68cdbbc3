"""Scenarios in which the ego departs among others on two lanes, a junction and two lanes more, for tests of departures."""

# ruff: noqa: E501  (one element per line)

from __future__ import annotations

from pathlib import Path

from sbt.errors import RunError
from sbt.execution.spec import ScenarioSpec

NET = """<net version="1.20" junctionCornerDetail="5" limitTurnSpeed="5.50">
    <location netOffset="0.00,0.00" convBoundary="0.00,0.00,600.00,0.00" origBoundary="0.00,0.00,600.00,0.00" projParameter="!"/>
    <edge id=":mid_0" function="internal">
        <lane id=":mid_0_0" index="0" speed="50.00" length="10.00" shape="300.00,-4.80 310.00,-4.80"/>
        <lane id=":mid_0_1" index="1" speed="50.00" length="10.00" shape="300.00,-1.60 310.00,-1.60"/>
    </edge>
    <edge id="road" from="west" to="mid" priority="1">
        <lane id="road_0" index="0" speed="50.00" length="300.00" shape="0.00,-4.80 300.00,-4.80"/>
        <lane id="road_1" index="1" speed="50.00" length="300.00" shape="0.00,-1.60 300.00,-1.60"/>
    </edge>
    <edge id="next" from="mid" to="east" priority="1">
        <lane id="next_0" index="0" speed="50.00" length="290.00" shape="310.00,-4.80 600.00,-4.80"/>
        <lane id="next_1" index="1" speed="50.00" length="290.00" shape="310.00,-1.60 600.00,-1.60"/>
    </edge>
    <junction id="west" type="dead_end" x="0.00" y="0.00" incLanes="" intLanes="" shape="0.00,0.00 0.00,-6.40"/>
    <junction id="mid" type="priority" x="305.00" y="0.00" incLanes="road_0 road_1" intLanes=":mid_0_0 :mid_0_1" shape="300.00,0.00 310.00,0.00 310.00,-6.40 300.00,-6.40">
        <request index="0" response="00" foes="00" cont="0"/>
        <request index="1" response="00" foes="00" cont="0"/>
    </junction>
    <junction id="east" type="dead_end" x="600.00" y="0.00" incLanes="next_0 next_1" intLanes="" shape="600.00,-6.40 600.00,0.00"/>
    <connection from="road" to="next" fromLane="0" toLane="0" via=":mid_0_0" dir="s" state="M"/>
    <connection from="road" to="next" fromLane="1" toLane="1" via=":mid_0_1" dir="s" state="M"/>
    <connection from=":mid_0" to="next" fromLane="0" toLane="0" dir="s" state="M"/>
    <connection from=":mid_0" to="next" fromLane="1" toLane="1" dir="s" state="M"/>
</net>
"""
HEAD = '<routes><vType id="car" length="5" width="1.8" sigma="0"/><vType id="truck" length="16.5" width="2.5" vClass="truck" sigma="0"/><vType id="bus" length="12" width="2.5" vClass="bus" sigma="0"/><vType id="unused" length="${p + 1}"/><route id="all" edges="road next"/><route id="end" edges="next"/>'
YAML = "sumo: {{net: net.net.xml, routes: [cars.rou.xml], options: {{{options}}}}}\ninputs: {{p: {{min: 0, max: 500}}}}\nego: {{id: {ego}{more}}}\nduration: 5\nothers: {{within: 120}}\nmetrics: [ttc_min, collision]\nrequirement: {{metric: ttc_min, critical: [-.inf, 1.0]}}\n"
ANYWHERE = 'insertionChecks="none"'
def car(name: str, pos: str, *, kind: str = "car", route: str = "all", depart: str = "0", speed: str = "0", lane: str = "0", more: str = ANYWHERE, inner: str = "") -> str:
    return f'<vehicle id="{name}" type="{kind}" route="{route}" depart="{depart}" departLane="{lane}" departPos="{pos}" departSpeed="{speed}" {more}>{inner}</vehicle>\n'


def stopped(lane: str, end: float, more: str = "") -> str:
    return f'<stop lane="{lane}" startPos="{max(end - 20, 0)}" endPos="{end}" duration="100" {more}/>'


def flow(pos: str, *, begin: str = "0", period: str = "0.5", speed: str = "5", more: str = "", name: str = "f") -> str:
    return f'<flow id="{name}" type="car" route="all" begin="{begin}" end="100" period="{period}" departLane="0" departPos="{pos}" departSpeed="{speed}" {more}/>\n'


def run(tmp_path: Path, vehicles: str, p: float = 100.0, *, ego: str = "ego", more: str = "", keys: str = "", loop: str = "", **options: str) -> tuple[str, str]:
    """Run the ego among the vehicles of a route file; returns the status, and the reason or why the run ended.

    Args:
        tmp_path: gets a folder with the files, as each file is read once per process.
        vehicles: elements of the route file, from its second line on.
        p: value of the input.
        ego: id.
        more: further keys of the ego.
        keys: further lines of the scenario.
        loop: Python source with `simulate`; it gets the started simulation, or starts it itself where `vehicles` are "".
        options: of SUMO, with _ for -.
    """
    folder = tmp_path / str(len(list(tmp_path.iterdir())))
    folder.mkdir()
    (folder / "net.net.xml").write_text(NET)
    (folder / "cars.rou.xml").write_text(f"{HEAD}\n{vehicles}</routes>")
    (folder / "loop.py").write_text(loop)
    written = ", ".join(f"{name.replace('_', '-')}: {value}" for name, value in options.items())
    text = YAML.format(ego=ego, more=more, options=written) + keys
    text = text.split("\n", 1)[1] if loop and not vehicles else text
    (folder / "scenario.yaml").write_text(text + ("simulate: loop.py:simulate\n" if loop else ""))
    scenario = ScenarioSpec(str(folder / "scenario.yaml")).resolve()
    try:
        return "ok", scenario.simulate({"p": p}, 1).ended
    except RunError as error:
        return str(error.status), error.reason
