"""Makes what people have: small networks and traffic as netgenerate, randomTrips, duarouter and editors leave them.

    python tests/own_scenarios.py FOLDER [NAME]...

writes a folder for each of `CASES` with a `my.sumocfg` (or `conf/my.sumocfg`) in it.
"""

# ruff: noqa: E501  (XML)

from __future__ import annotations

import gzip
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

__all__ = ["CASES", "make", "program", "tools"]

ROOT = Path(__file__).resolve().parent.parent
Case = Callable[[Path], Path]


def program(name: str) -> str | None:
    """Return one of SUMO's programs; None where it is not installed."""
    return shutil.which(name, path=os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")]))


def tools() -> Path | None:
    """Return the folder of SUMO's scripts; None where it is not installed."""
    try:
        import sumo
    except ImportError:
        return None
    return Path(sumo.SUMO_HOME) / "tools"


def _call(folder: Path, *words: str) -> None:
    home = tools()
    environment = {**os.environ, "SUMO_HOME": str(home.parent)} if home is not None else {**os.environ}
    done = subprocess.run([*words], cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(words)}: {done.stdout}{done.stderr}")


def _sumo(folder: Path, name: str, *words: str) -> None:
    _call(folder, program(name) or name, *words)


def _trips(folder: Path, net: str, out: str, *words: str) -> None:
    home = tools()
    script = str((home or Path()) / "randomTrips.py")
    _call(folder, sys.executable, script, "-n", net, "-o", out, "--seed", "5", *words)


def _grid(folder: Path, *words: str, out: str = "g.net.xml") -> None:
    _sumo(folder, "netgenerate", "--grid", "--grid.number", "4", "--grid.length", "110", "--seed", "2", "-o", out, *words)


def _config(folder: Path, routes: str = "", additional: str = "", net: str = "g.net.xml", more: str = "") -> Path:
    parts = [f'<net-file value="{net}"/>']
    parts += [f'<route-files value="{routes}"/>'] if routes else []
    parts += [f'<additional-files value="{additional}"/>'] if additional else []
    path = folder / "my.sumocfg"
    path.write_text(f"<configuration><input>{''.join(parts)}</input>{more}</configuration>\n")
    return path


def numeric(folder: Path) -> Path:
    """Trips of randomTrips, numbered from 0, in a grid with traffic lights."""
    _grid(folder, "--tls.guess")
    _trips(folder, "g.net.xml", "t.trips.xml", "-e", "200", "-p", "1.2")
    return _config(folder, "t.trips.xml")


def packed(folder: Path) -> Path:
    """Network and routes of duarouter, both as .gz."""
    _grid(folder, out="g.net.xml.gz")
    _trips(folder, "g.net.xml.gz", "t.trips.xml", "-e", "150", "-p", "1", "-r", "r.rou.xml")
    (folder / "r.rou.xml.gz").write_bytes(gzip.compress((folder / "r.rou.xml").read_bytes()))
    (folder / "r.rou.xml").unlink()
    return _config(folder, "r.rou.xml.gz", net="g.net.xml.gz")


_FLOWS = """<routes>
    <vType id="car" sigma="0.5"/><vType id="lorry" vClass="truck" length="10" maxSpeed="22"/>
    <flow id="south" type="car" begin="0" end="600" vehsPerHour="500" from="A1B1" to="C1D1" departSpeed="max"/>
    <flow id="cröss/1" type="car" begin="0" end="600" period="8" from="B0B1" to="B2B3"/>
    <flow id="by_chance" type="lorry" begin="0" end="600" probability="0.08" from="C3C2" to="C1C0"/>
    <flow id="poisson" type="car" begin="0" end="600" period="exp(0.1)" from="D1C1" to="B1A1"/>
</routes>"""


def flows(folder: Path) -> Path:
    """Flows alone, with every way to say how many."""
    _grid(folder)
    (folder / "f.rou.xml").write_text(_FLOWS, encoding="utf-8")
    return _config(folder, "f.rou.xml")


def additional(folder: Path) -> Path:
    """Vehicle types, routes and vehicles under additional-files, and no route files."""
    _grid(folder)
    (folder / "types.add.xml").write_text('<additional><vType id="t" tau="1.2" carFollowModel="IDM"/></additional>')
    vehicles = "".join(f'<vehicle id="v{n}" type="t" route="{"ns"[n % 2]}" depart="{2 * n}" departSpeed="max"/>\n' for n in range(60))
    (folder / "cars.add.xml").write_text(
        f'<additional><route id="n" edges="A1B1 B1C1 C1D1"/><route id="s" edges="B0B1 B1B2 B2B3"/>{vehicles}</additional>'
    )
    return _config(folder, additional="types.add.xml,cars.add.xml")


def people(folder: Path) -> Path:
    """Cars, lorries, bicycles and pedestrians on streets with sidewalks and crossings."""
    _grid(folder, "--sidewalks.guess", "--crossings.guess", "--tls.guess", "--no-internal-links", "false")
    for kind, period, name in (("passenger", "1.5", "c"), ("truck", "10", "t"), ("bicycle", "6", "b")):
        _trips(folder, "g.net.xml", f"{name}.trips.xml", "-e", "200", "-p", period, "--vehicle-class", kind, "--prefix", name)
    _trips(folder, "g.net.xml", "p.rou.xml", "-e", "200", "-p", "3", "--pedestrians", "--prefix", "p", "--max-distance", "400")
    (folder / "pf.rou.xml").write_text(
        '<routes><personFlow id="crowd" begin="0" end="200" probability="0.1"><walk from="A1B1" to="C1D1"/></personFlow></routes>'
    )
    return _config(folder, "c.trips.xml,t.trips.xml,b.trips.xml,p.rou.xml,pf.rou.xml")


def roundabout(folder: Path) -> Path:
    """A roundabout with trips through it."""
    shutil.copy(ROOT / "sumo_nets" / "roundabout" / "roundabout.net.xml", folder / "g.net.xml")
    _trips(folder, "g.net.xml", "t.trips.xml", "-e", "150", "-p", "2", "--fringe-factor", "max", "--trip-attributes", 'departSpeed="max"')
    return _config(folder, "t.trips.xml")


def old(folder: Path) -> Path:
    """A network as SUMO 0.13 wrote it, without what came later, and the routes of that time."""
    _grid(folder, "--no-turnarounds")
    net = folder / "g.net.xml"
    text = re.sub(r"<net [^>]*>", '<net version="0.13">', net.read_text())
    net.write_text(re.sub(r' (?:disallow|allow|customShape|length2)="[^"]*"', "", text))
    _trips(folder, "g.net.xml", "t.trips.xml", "-e", "150", "-p", "1.5")
    return _config(folder, "t.trips.xml", more='<time><begin value="0"/><end value="1000"/></time>')


def alternatives(folder: Path) -> Path:
    """Routes of duarouter with their alternatives (.rou.alt.xml), in a random network with bends."""
    _sumo(folder, "netgenerate", "--rand", "--rand.iterations", "40", "--rand.grid", "--seed", "7", "-o", "g.net.xml")
    _trips(folder, "g.net.xml", "t.trips.xml", "-e", "150", "-p", "1.2", "--validate", "-r", "r.rou.xml")
    _sumo(folder, "duarouter", "-n", "g.net.xml", "-r", "t.trips.xml", "-o", "d.rou.xml", "--ignore-errors")
    return _config(folder, "d.rou.alt.xml")


def distributions(folder: Path) -> Path:
    """A distribution of types, named routes and a distribution of them, vias, an included file, and two route files."""
    _grid(folder, "--grid.attach-length", "60")
    (folder / "types.xml").write_text(
        '<routes><vTypeDistribution id="mix"><vType id="slow" probability="0.5" maxSpeed="9" sigma="0.8"/>'
        '<vType id="quick" probability="0.5" speedFactor="normc(1.1,0.1,0.8,1.4)" emergencyDecel="5"/></vTypeDistribution></routes>'
    )
    edges = re.findall(r'<edge id="([^":]+)"', (folder / "g.net.xml").read_text())
    assert {"A1B1", "B1C1", "C1D1", "B0B1", "B1B2", "B2B3"} <= set(edges)
    cars = "".join(f'<vehicle id="a{n}" type="mix" route="either" depart="{3 * n}"/>\n' for n in range(50))
    (folder / "a.rou.xml").write_text(
        '<routes><include href="types.xml"/><route id="east" edges="A1B1 B1C1 C1D1"/>'
        '<route id="north" edges="A1B1 B1B2 B2B3"/><routeDistribution id="either"><route refId="east" probability="1"/>'
        f'<route refId="north" probability="2"/></routeDistribution>{cars}</routes>'
    )
    trips = "".join(f'<trip id="b{n}" type="mix" depart="{3 * n + 1}" from="B0B1" to="B2B3" via="C1C2"/>\n' for n in range(50))
    (folder / "b.rou.xml").write_text(f"<routes>{trips}</routes>")
    return _config(folder, "a.rou.xml,b.rou.xml")


def elsewhere(folder: Path) -> Path:
    """A configuration in another folder than its files, blanks in names, options, outputs, and a late beginning."""
    for name in ("conf", "my net", "out"):
        (folder / name).mkdir()
    _grid(folder / "my net", "--tls.guess", "-L", "2")
    (folder / "conf" / "t.add.xml").write_text('<additional><vType id="bus" vClass="bus"/><vType id="car" minGap="2"/></additional>')
    _trips(folder / "my net", "g.net.xml", "t.rou.xml", "-b", "3600", "-e", "3800", "-p", "0.8", "--trip-attributes",
           'type="car" departLane="best" departSpeed="max" departPos="random"')  # fmt: skip
    time = '<time><begin value="3600"/><end value="4500"/><step-length value="0.5"/></time>'
    more = f'{time}<output><fcd-output value="../out/fcd.xml"/></output><processing><lateral-resolution value="0.8"/></processing>'
    return _config(folder / "conf", "../my net/t.rou.xml", "t.add.xml", "../my net/g.net.xml", more)


def named(folder: Path) -> Path:
    """Ids with umlauts, slashes, points and signs, some of them references to characters, and placeholders nowhere."""
    _grid(folder)
    ids = ["ü/1", "x#2", "a:b", "1.5", "007", "no", "1e3", "ß&#228;", "v.0", "-3"]
    cars = "".join(
        f'<vehicle id="{name}{"" if n < 10 else n}" depart="{2 * n}"><route edges="{way}"/></vehicle>\n'
        for n in range(50) for name in [ids[n % 10]]
        for way in ["A1B1 B1C1 C1D1" if n % 2 else "B0B1 B1B2 B2B3"]
    )  # fmt: skip
    (folder / "c.rou.xml").write_text(f'<?xml version="1.0" encoding="UTF-8"?>\n<routes>{cars}</routes>', encoding="utf-8")
    return _config(folder, "c.rou.xml")


CASES: dict[str, Case] = {
    case.__name__: case
    for case in (
        numeric, packed, flows, additional, people, roundabout, old, alternatives, distributions, elsewhere, named,
    )
}  # fmt: skip


def make(name: str, folder: Path) -> Path:
    """Make a case in a new folder and return its configuration."""
    folder.mkdir(parents=True)
    return CASES[name](folder)


if __name__ == "__main__":
    for wanted in sys.argv[2:] or CASES:
        print(make(wanted, Path(sys.argv[1]).resolve() / wanted))
