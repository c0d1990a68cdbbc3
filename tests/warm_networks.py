"""A small town as it is hard for saved states: actuated lights, walkers, buses with riders, rerouting devices, drawn flows."""

from __future__ import annotations

import random
import tempfile
from functools import cache
from pathlib import Path

from tests.own_networks import run_program

T0 = 42.0
_SCENARIO = """sumo: {{net: town.net.xml, routes: [cars.rou.xml, buses.rou.xml, ego.rou.xml], additional: [stops.add.xml],
       options: {{device.rerouting.probability: 0.2, {options}}}}}
inputs: {{accel: {{min: 1, max: 3, unit: m/s^2}}, tau: {{min: 0.5, max: 2, unit: s}}{inputs}}}
ego: {{id: ego, delay: 20{ego}}}
duration: 3
{warm_up}
metrics: [ttc_path_min, distance_min]
requirement: {{metric: ttc_path_min, critical: [-.inf, 1.0]}}
"""


def _edge(rng: random.Random) -> str:
    column, row = rng.randrange(3), rng.randrange(4)
    return f"{'ABCD'[column]}{row}{'ABCD'[column + 1]}{row}"


@cache
def _net() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        words = "--grid --grid.number 4 --grid.length 100 -L 2 --tls.guess --tls.default-type actuated --sidewalks.guess"
        run_program(Path(folder), "netgenerate", *words.split(), "--crossings.guess", "--seed", "1", "-o", "town.net.xml")
        return (Path(folder) / "town.net.xml").read_bytes()


def town(
    folder: Path, *, depart: str = "44", warm_up: str = "warm_up: {seeds: 2}", options: str = "", inputs: str = "", ego: str = "",
    more: str = "",
) -> Path:  # fmt: skip
    """Write the town with its traffic and a scenario about an ego that departs at some time, and return the scenario."""
    folder.mkdir(exist_ok=True)
    (folder / "town.net.xml").write_bytes(_net())
    rng, traffic = random.Random(1), []
    device = '<param key="has.rerouting.device" value="true"/>'
    for k in range(70):
        time, inside = rng.uniform(0, 60), device if k % 5 == 0 else ""
        kind = "mixed" if k % 2 else "car"
        way = f'from="{_edge(rng)}" to="{_edge(rng)}"'
        traffic.append((time, f'<trip id="t{k}" type="{kind}" depart="{time:.2f}" {way}>{inside}</trip>'))
    for k in range(12):
        time = rng.uniform(0, 60)
        traffic.append((time, f'<person id="p{k}" depart="{time:.2f}"><walk from="{_edge(rng)}" to="{_edge(rng)}"/></person>'))
    types = """<vType id="car" sigma="0.5" speedFactor="normc(1,0.1,0.2,2)"/>
      <vTypeDistribution id="mixed"><vType id="fast" sigma="0.4" probability="0.7"/>
      <vType id="slow" sigma="0.8" maxSpeed="10" probability="0.3"/></vTypeDistribution>"""
    cars = "\n".join(text for _, text in sorted(traffic))
    (folder / "cars.rou.xml").write_text(f"<routes>{types}\n{cars}</routes>")
    ride = '<walk from="A2B2" busStop="bs0"/><ride busStop="bs1" lines="L"/>'
    riders = "".join(f'<person id="r{k}" depart="{5 * k}">{ride}</person>' for k in range(8))
    (folder / "buses.rou.xml").write_text(f"""<routes><vType id="bus" vClass="bus" length="12"/>
      <flow id="drawn" type="mixed" begin="0" end="999" probability="0.2" from="A1B1" to="C1D1"/>
      <flow id="bus" type="bus" begin="0" end="999" period="20" line="L"><route edges="A2B2 B2C2 C2D2"/>
        <stop busStop="bs0" duration="4"/><stop busStop="bs1" duration="4"/></flow>{riders}
      <flow id="late" type="car" begin="45" end="999" period="3" from="A3B3" to="C3D3"/></routes>""")
    (folder / "stops.add.xml").write_text(f"""<additional><busStop id="bs0" lane="A2B2_1" startPos="40" endPos="60"/>
      <busStop id="bs1" lane="C2D2_1" startPos="40" endPos="60"/>
      <inductionLoop id="loop" lane="B2C2_1" pos="50" period="10" file="loop.xml"/>{more}</additional>""")
    (folder / "ego.rou.xml").write_text(f"""<routes><vType id="av" sigma="0" tau="${{tau}}" accel="${{accel}}"/>
      <trip id="ego" type="av" depart="{depart}" from="A2B2" to="C3D3" departLane="free" departSpeed="0"/></routes>""")
    text = _SCENARIO.format(warm_up=warm_up, options=options, inputs=inputs, ego=ego)
    (folder / "scenario.yaml").write_text(text)
    return folder / "scenario.yaml"
