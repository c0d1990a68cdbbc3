"""A run as files for other programs: trajectories in SUMO's format, and a scene for sumo-gui."""

from __future__ import annotations

import csv
import math
import shutil
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from sbt.files import as_cell
from sbt.metrics.geometry import corners, select_instants
from sbt.problem.trace import Trace
from sbt.report.scene import is_person

__all__ = ["write_csv", "write_fcd", "write_folder"]

_COLORS = ("31,111,180", "217,130,43", "77,146,33", "148,103,189", "140,86,75")


def write_folder(folder: Path, trace: Trace, net: Path | None) -> list[Path]:
    """Write the files that show a run in other programs, and return them.

    `trace.csv` (centres, radians), `fcd.xml` (SUMO's own format and conventions), and where there is a
    network a copy of it, the paths and the first and last rectangles as `scene.add.xml`, and
    `scene.sumocfg`, which sumo-gui opens.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(folder / "trace.csv", trace)
    write_fcd(folder / "fcd.xml", trace)
    files = [folder / "trace.csv", folder / "fcd.xml"]
    if net is None:
        return files
    copy = folder / net.name
    shutil.copyfile(net, copy)
    (folder / "scene.add.xml").write_text(_shapes(trace))
    end = float(trace.time[-1])
    (folder / "scene.sumocfg").write_text(
        f"<configuration>\n  <input>\n    <net-file value={quoteattr(net.name)}/>\n"
        f'    <additional-files value="scene.add.xml"/>\n  </input>\n  <time><begin value="0"/><end value="{end:g}"/></time>\n'
        f"</configuration>\n"
    )
    return [*files, copy, folder / "scene.add.xml", folder / "scene.sumocfg"]


def write_csv(file: Path, trace: Trace) -> None:
    """Write one row a time and actor: time, actor, x, y, heading, speed, acceleration, length, width."""
    rows = trace.rows()
    with file.open("w", newline="") as out:
        writer = csv.DictWriter(out, list(rows[0]))
        writer.writeheader()
        writer.writerows({key: as_cell(value) for key, value in row.items()} for row in rows)


def write_fcd(file: Path, trace: Trace) -> None:
    """Write floating-car data as SUMO does: front bumpers (people: middles), degrees clockwise from north."""
    present = trace.present
    with file.open("w") as out:
        out.write("<fcd-export>\n")
        for k, time in enumerate(trace.time.tolist()):
            out.write(f'  <timestep time="{time:.3f}">\n')
            for j, name in enumerate(trace.actors):
                if not present[k, j]:
                    continue
                heading, length = float(trace.heading[k, j]), float(trace.length[j])
                person = is_person(trace, j)
                front = 0.0 if person else 0.5 * length
                x, y = float(trace.x[k, j]) + front * math.cos(heading), float(trace.y[k, j]) + front * math.sin(heading)
                angle = (90.0 - math.degrees(heading)) % 360.0
                out.write(
                    f'    <{"person" if person else "vehicle"} id={quoteattr(name)} x="{x!r}" y="{y!r}" angle="{angle!r}" '
                    f'speed="{float(trace.speed[k, j])!r}" acceleration="{float(trace.acceleration[k, j])!r}" '
                    f'length="{length!r}" width="{float(trace.width[j])!r}"/>\n'
                )
            out.write("  </timestep>\n")
        out.write("</fcd-export>\n")


def _shapes(trace: Trace) -> str:
    """Return paths, and the rectangles at the first and last instant at which somebody is there, as polygons."""
    lines, present = [], trace.present
    for j, name in enumerate(trace.actors):
        color = _COLORS[min(j, len(_COLORS) - 1)]
        there = np.flatnonzero(present[:, j])
        if there.size == 0:
            continue
        boxes = corners(select_instants(trace.actor(name), there))  # (n, 4, 2)
        for where, k in (("start", 0), ("end", -1)):
            lines.append(_polygon(f"{name} {where}", color, boxes[k], "1"))
        path = np.stack([trace.x[there, j], trace.y[there, j]], axis=1)
        if len(path) > 1 and float(np.ptp(path, axis=0).max()) > 0.0:
            lines.append(_polygon(f"{name} path", color, path, "0"))
    return "<additional>\n" + "\n".join(lines) + "\n</additional>\n"


def _polygon(name: str, color: str, points: np.ndarray, fill: str) -> str:
    shape = " ".join(f"{x:.3f},{y:.3f}" for x, y in points.tolist())
    return f'  <poly id={quoteattr(name.replace(" ", "_"))} color="{color}" fill="{fill}" layer="10" shape="{shape}"/>'
