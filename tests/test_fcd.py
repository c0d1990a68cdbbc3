"""Metrics of recorded traffic: FCD files in, the catalogue out, equal to that of the trace that was recorded."""

from __future__ import annotations

import csv
import gzip
import io
import json
import math
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from sbt.cli import app
from sbt.errors import InputError
from sbt.metrics.fcd import catalogue, encounters, near_pairs, pair_traces, read_fcd
from sbt.metrics.longitudinal import COLLISION

ENTITY = '<!DOCTYPE fcd-export [<!ENTITY x SYSTEM "file:///etc/passwd">]><fcd-export>&x;</fcd-export>'


def row(time: float, name: str, x: float, y: float = 0.0, angle: float = 90.0, speed: float = 10.0, **more: object) -> dict:
    return {"time": time, "id": name, "x": x, "y": y, "angle": angle, "speed": speed, **more}


def as_xml(rows: list[dict]) -> str:
    lines = ["<fcd-export>"]
    for time in dict.fromkeys(r["time"] for r in rows):
        lines.append(f'<timestep time="{time}">')
        for r in rows:
            if r["time"] == time:
                tag = "person" if r["id"].startswith("ped") else "vehicle"
                lines.append(f"<{tag} " + " ".join(f'{k}="{v}"' for k, v in r.items() if k != "time") + "/>")
        lines.append("</timestep>")
    return "\n".join([*lines, "</fcd-export>"])


def as_csv(rows: list[dict], separator: str = ",", prefix: str = "") -> str:
    names = {k: f"timestep_{k}" if prefix and k == "time" else f"{prefix}{k}" for k in rows[0]}
    text = io.StringIO()
    writer = csv.DictWriter(text, list(names.values()), delimiter=separator)
    writer.writeheader()
    writer.writerows({names[k]: v for k, v in r.items()} for r in rows)
    return text.getvalue()


def written(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_bytes(gzip.compress(text.encode()) if name.endswith(".gz") else text.encode())
    return path


DRIVE = [row(0.5 * k, n, x0 + 0.5 * k * v, speed=v) for k in range(9) for n, x0, v in (("7", 0.0, 15.0), ("8", 40.0, 10.0))]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.xml", as_xml(DRIVE)),
        ("a.xml.gz", as_xml(DRIVE)),
        ("a.csv", as_csv(DRIVE)),
        ("a.csv", as_csv(DRIVE, ";", "vehicle_")),
        ("a.csv.gz", as_csv(DRIVE[::-1], ";", "vehicle_")),
    ],
)
def test_every_format_gives_the_same(tmp_path, name, text):
    recording = read_fcd(written(tmp_path, name, text))
    assert recording.names == ("7", "8")
    [(ego, other, trace), (back, _, _)] = encounters(recording, 100.0)
    assert (ego, other, back, trace.actors) == ("7", "8", "8", ("ego", "co"))
    np.testing.assert_array_equal(trace.time, np.arange(9) * 0.5)
    np.testing.assert_allclose(trace.x[:, 0], 7.5 * np.arange(9) - 2.5)  # the centre, half a length behind the bumper
    np.testing.assert_array_equal(trace.heading, 0.0)
    metrics = {m.name: m(trace) for m in catalogue()}
    assert metrics["d_min"] == pytest.approx(35.0 - 4 * 5.0)
    assert metrics["ttc_min"] == pytest.approx(3.0)


def test_parquet(tmp_path):
    pytest.importorskip("pyarrow")
    import pandas as pd

    path = tmp_path / "a.parquet"
    pd.DataFrame([{("timestep_" if k == "time" else "vehicle_") + k: v for k, v in r.items()} for r in DRIVE]).to_parquet(path)
    np.testing.assert_array_equal(read_fcd(path).x, read_fcd(written(tmp_path, "a.xml", as_xml(DRIVE))).x)


def test_angles_sizes_and_accelerations(tmp_path):
    rows = [row(t, "north", 3.0, 10.0 * t, 0.0, 10.0 + 2 * t, length=4, width=2) for t in (0.0, 1.0)]
    rows += [row(t, "ped", 0.0, 0.0, 180.0, 1.0) for t in (0.0, 1.0)]
    rows += [row(t, "west", 0.0, 0.0, 270.0, 5.0, acceleration=0.25) for t in (0.0, 1.0)]
    recording = read_fcd(written(tmp_path, "a.xml", as_xml(rows)), length=6.0, width=1.5)
    assert recording.names == ("north", "ped", "west")
    np.testing.assert_allclose(recording.length, [4, 0.215, 6])
    np.testing.assert_allclose(recording.width, [2, 0.478, 1.5])
    np.testing.assert_allclose(np.cos(recording.heading), [0, 0, 0, 0, -1, -1], atol=1e-12)
    np.testing.assert_allclose(np.sin(recording.heading), [1, 1, -1, -1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(recording.y[:2], [-2.0, 8.0])
    np.testing.assert_allclose(recording.x[4:], 3.0)
    np.testing.assert_allclose(recording.acceleration, [0, 2, 0, 0, 0.25, 0.25])


def test_a_gap_or_a_jump_begins_a_new_interval(tmp_path):
    times = np.arange(12.0)
    rows = [row(t, "a", 10.0 * t) for t in times]
    rows += [row(t, "b", 10.0 * t + 20 + (900 if t >= 8 else 0)) for t in times if t != 4]
    rows += [row(t, "once", 0.0, 1e4) for t in (3.0,)]
    recording = read_fcd(written(tmp_path, "a.csv", as_csv(rows)))
    spans = [(t.time[0], t.time[-1]) for t in pair_traces(recording, 0, 1)]
    assert spans == [(0, 3), (5, 7), (8, 11)]
    assert list(pair_traces(recording, 0, 2)) == []
    assert near_pairs(recording, 25.0) == [(0, 1)]
    assert near_pairs(recording, 19.0) == []


@pytest.mark.parametrize(("moved", "spans"), [(3.0, [(0, 11)]), (12.0, [(0, 5), (6, 11)])])
def test_a_walker_who_is_put_over_a_junction_begins_a_new_interval(moved: float, spans: list[tuple[int, int]], tmp_path):
    """SUMO puts walkers up to 3.4 m aside onto crossings; without walking areas over the junction, 10 to 17 m in a step."""
    rows = [row(t, "ped", 0.0, 1.2 * t + (moved if t >= 6 else 0), 0.0, 1.2) for t in np.arange(12.0)]
    rows += [row(t, "a", 10.0 * t) for t in np.arange(12.0)]
    recording = read_fcd(written(tmp_path, "a.xml", as_xml(rows)))
    assert [(t.time[0], t.time[-1]) for t in pair_traces(recording, 0, 1)] == spans


def test_no_acceleration_is_taken_across_a_gap_or_a_jump(tmp_path):
    """Who was teleported from 20 m/s to a standstill had braked with 200 m/s^2, who stood after a gap with 2."""
    times = np.round(np.arange(0.0, 12.0, 0.1), 1)
    rows = [row(t, "teleported", *((20.0 * t, 0.0) if t < 4 else (110.0, 0.0)), speed=20.0 * (t < 4)) for t in times]
    rows += [row(t, "seen", 20.0 * min(t, 2.0), 9.0, speed=20.0 * (t < 2)) for t in times if t < 2 or t > 10.05]
    rows += [row(t, "brakes", 60.0, -9.0, speed=round(20.0 - t, 1)) for t in times if t < 5 or t > 10.05]
    recording = read_fcd(written(tmp_path, "a.csv", as_csv(rows)))
    assert recording.names == ("brakes", "seen", "teleported")
    there, first, last = (recording.acceleration[slice(*recording.start[k : k + 2])] for k in range(3))
    firsts = [0, int((times < 5).sum())]
    np.testing.assert_allclose(there, [0.0 if k in firsts else -1.0 for k in range(len(there))])
    assert not first.any()
    assert not last.any()


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.xml", ENTITY, "document type or entities"),
        ("a.xml", '<?xml version="1.0"?><!DOCTYPE fcd-export SYSTEM "x.dtd"><fcd-export/>', "document type or entities"),
        ("a.xml", as_xml(DRIVE)[:-20], "must be whole"),
        ("a.xml", as_xml(DRIVE).replace('speed="10.0"', "", 1), "line 4: attribute 'speed' is missing"),
        ("a.xml", as_xml(DRIVE).replace('x="0.0"', 'x="left"', 1), "line 3: could not convert"),
        ("a.xml", as_xml(DRIVE).replace('x="0.0"', 'x="nan"', 1), "x of every road user"),
        ("a.xml", "<fcd-export/>", "must have road users"),
        ("a.xml", "", "must be whole"),
        ("a.xml.gz", as_xml(DRIVE), "must be whole"),
        ("a.csv", as_csv(DRIVE).replace("angle", "bearing"), "angle is missing"),
        ("a.csv", as_csv(DRIVE).replace("40.0", "forty", 1), "must be numbers"),
        ("a.csv", as_csv([*DRIVE, DRIVE[0]]), "occur once per time step"),
        ("a.csv", "", "must be a table"),
        ("a.csv", as_csv([r | {"x": 13.4 + r["x"] * 1e-5} for r in DRIVE]), "fcd-output.geo"),
        ("a.txt", "", "must end in"),
    ],
)
def test_bad_files_are_an_input_error(tmp_path, name, text, words):
    path = written(tmp_path, name, text)
    if name.endswith(".gz"):
        path.write_text(text)
    with pytest.raises(InputError, match=words):
        read_fcd(path)


def test_missing_files_and_sizes_are_input_errors(tmp_path):
    with pytest.raises(InputError, match="readable"):
        read_fcd(tmp_path / "none.xml")
    with pytest.raises(InputError, match="length > 0"):
        read_fcd(written(tmp_path, "a.xml", as_xml(DRIVE)), length=-1.0)


def test_the_metrics_verb(tmp_path):
    path, out = written(tmp_path, "a.xml", as_xml(DRIVE)), tmp_path / "m.csv"
    printed = CliRunner().invoke(app, ["metrics", str(path)])
    assert printed.exit_code == 0, printed.output
    rows = list(csv.DictReader(io.StringIO(printed.stdout)))
    assert [(r["ego"], r["other"], r["begin"], r["end"]) for r in rows] == [("7", "8", "0.0", "4.0"), ("8", "7", "0.0", "4.0")]
    assert CliRunner().invoke(app, ["metrics", str(path), "--out", str(out)]).exit_code == 0
    assert list(csv.DictReader(out.open())) == rows
    result = json.loads(CliRunner().invoke(app, ["metrics", str(path), "--json", "--length", "4"]).stdout)
    assert (result["road_users"], result["steps"], len(result["pairs"])) == (2, 9, 2)
    assert result["units"]["ttc_min"] == "s"
    assert result["pairs"][0]["d_min"] == pytest.approx(16.0)
    assert result["pairs"][1]["ttc_min"] == 10.0  # the one ahead has nobody in its path; overtaking is no verdict
    assert json.loads(CliRunner().invoke(app, ["metrics", str(path), "--json", "--pairs", "within=5"]).stdout)["pairs"] == []
    for bad in (["--pairs", "near"], ["--pairs", "within=-1"], ["--width", "0"], ["--out", str(tmp_path / "no" / "m.csv")]):
        assert CliRunner().invoke(app, ["metrics", str(path), *bad]).exit_code == 2


def test_many_road_users_in_little_time(tmp_path):
    rng = np.random.default_rng(0)
    rows = [
        row(float(t), f"v{k}", 12.0 * t + 15.0 * k, 3.5 * (k % 3), 90.0, 12.0 + rng.normal())
        for t in range(20)
        for k in range(40)
    ]
    recording = read_fcd(written(tmp_path, "a.csv", as_csv(rows)))
    assert len(near_pairs(recording, 100.0)) == sum(40 - d for d in range(1, 7))


RUN = """
import pickle, sys
from dataclasses import replace
from sbt.scenarios.cut_in import SCENARIO
from sbt.sumo.session import libsumo
xml, out = sys.argv[1:]
simulate = replace(SCENARIO.simulate, options=("--fcd-output", xml, "--precision", "9", "--fcd-output.acceleration", "true"),
                   isolation="fresh")
trace = simulate({"d_v": 60.0, "d_t": 0.9}, 3)
libsumo().close()
pickle.dump(trace, open(out, "wb"))
"""


@pytest.mark.sumo
def test_sumos_file_gives_the_metrics_of_the_recorded_trace(tmp_path):
    xml, out = tmp_path / "fcd.xml", tmp_path / "trace.pickle"
    subprocess.run([sys.executable, "-c", RUN, str(xml), str(out)], check=True, capture_output=True)
    trace = pickle.loads(out.read_bytes())
    recording = read_fcd(xml)
    assert recording.names == ("co", "ego")
    [found] = pair_traces(recording, recording.names.index("ego"), recording.names.index("co"))
    assert found.time.shape == trace.time.shape
    for name in ("time", "x", "y", "heading", "speed", "acceleration", "length", "width"):
        np.testing.assert_allclose(getattr(found, name), getattr(trace, name), atol=2e-7, err_msg=name)
    for metric in catalogue():
        assert metric(found) == pytest.approx(metric(trace), rel=1e-5, abs=1e-4), metric.name
    assert not math.isclose(next(m for m in catalogue() if m.name == "ttc_min")(found), 10.0)


def on_a_viaduct(step: float, above: float | None, slope: float | None = None) -> list[dict]:
    """Two cars that meet in the plane where their roads cross, at 15 m/s; one is so high above the other (m)."""
    rows = []
    for t in np.arange(0.0, 12.0 + 1e-9, step):
        for name, x, y, angle, z in (("7", 15.0 * (t - 6.0), 0.0, 90.0, 0.0), ("8", 0.0, 15.0 * (t - 6.0), 0.0, above)):
            heights = {} if above is None else {"z": z} if slope is None else {"z": z, "slope": slope}
            rows.append(row(float(t), name, x, y, angle, 15.0, **heights))
    return rows


def ramp(x: float) -> tuple[float, float]:
    """Height (m) and slope (degrees) of a road that rises from 0 to 6 m over 60 m, and of one below it from there on."""
    return min(max(0.1 * (x - 100.0), 0.0), 6.0), math.degrees(math.atan(0.1)) if 100.0 < x < 160.0 else 0.0


@pytest.mark.parametrize("step", [0.1, 1.0])
@pytest.mark.parametrize("write", [as_xml, as_csv])
def test_who_is_on_a_bridge_does_not_meet_who_is_below(tmp_path: Path, write, step: float) -> None:
    """The file's z was not read: they collided in every metric."""
    suffix = "xml" if write is as_xml else "csv"
    pairs = {}
    for above in (None, 0.5, 6.0):
        recording = read_fcd(written(tmp_path, f"{above}.{suffix}", write(on_a_viaduct(step, above))))
        pairs[above] = list(encounters(recording, 50.0))
    assert pairs[6.0] == []
    for above in (None, 0.5):
        assert [COLLISION(trace) for *_, trace in pairs[above]] == [1.0, 1.0]


def test_who_drives_on_behind_or_ahead_on_a_ramp_is_on_the_same_level(tmp_path: Path) -> None:
    """Also where the slopes of both roads, which are flat there, do not lead to the other's height."""
    rows = [row(float(t), name, x, 0.0, 90.0, 15.0, z=ramp(x)[0], slope=ramp(x)[1])
            for t in np.arange(0.0, 20.0, 0.5) for name, x in (("7", 15.0 * t), ("8", 15.0 * t + 70.0))]  # fmt: skip
    below = [row(float(t), "9", 200.0, 15.0 * t - 100.0, 0.0, 15.0, z=0.0, slope=0.0) for t in np.arange(0.0, 20.0, 0.5)]
    recording = read_fcd(written(tmp_path, "a.xml", as_xml(sorted(rows + below, key=lambda one: one["time"]))))
    assert recording.stacked
    (trace,) = pair_traces(recording, 0, 1)
    assert len(trace.time) == 40
    assert near_pairs(recording, 75.0) == [(0, 1)]


def test_heights_of_hills_change_nothing(tmp_path: Path) -> None:
    hill = [one | {"z": 0.12 * one["x"]} for one in DRIVE]
    plain, high = (read_fcd(written(tmp_path, f"{k}.xml", as_xml(rows))) for k, rows in enumerate((DRIVE, hill)))
    assert not high.stacked
    assert all(a[2].identical(b[2]) for a, b in zip(encounters(plain, 100.0), encounters(high, 100.0), strict=True))


def test_collisions_in_a_file_without_heights_are_told_to_be_in_the_plane(tmp_path: Path) -> None:
    for above, told in ((None, True), (0.5, False)):
        path = written(tmp_path, f"{above}.xml", as_xml(on_a_viaduct(0.1, above)))
        result = CliRunner().invoke(app, ["metrics", str(path), "--json"])
        assert result.exit_code == 0
        assert json.loads(result.stdout)["heights"] is not told
        assert ("no heights (z)" in result.stderr) is told


def test_sizes_that_a_file_does_not_have_are_told(tmp_path: Path) -> None:
    """A bicycle was a car of 5 m, and in collisions, without a word."""
    sized = [one | {"length": 1.6, "width": 0.6} for one in DRIVE]
    name = str(DRIVE[0]["id"])
    half = [one if one["id"] == name else both for one, both in zip(DRIVE, sized, strict=True)]
    users = len({one["id"] for one in DRIVE})
    for k, (rows, told) in enumerate(((DRIVE, users), (sized, 0), (half, 1))):
        result = CliRunner().invoke(app, ["metrics", str(written(tmp_path, f"{k}.xml", as_xml(rows))), "--json"])
        assert (result.exit_code, json.loads(result.stdout)["assumed_sizes"]) == (0, told)
        assert (f"{told} of {users} vehicles have no length or width" in result.stderr) is bool(told)


@pytest.mark.parametrize("step", [0.1, 0.5, 1.0])
def test_who_is_put_past_another_by_sumo_has_not_driven_through_it(tmp_path: Path, step: float) -> None:
    """SUMO teleports who waits too long: 15 m ahead was a collision at 14 m/s, at every step. Changes of lanes are none."""
    time = [round(step * k, 3) for k in range(12)]
    stands = [row(t, "8", 100.0, speed=0.0) for t in time]
    drives = [row(t, "7", 108.9 + 13.9 * (t - time[6]), speed=13.9) for t in time[6:]]
    waits = [row(t, "7", 94.0, speed=0.0) for t in time[:6]] + drives
    both = sorted(stands + waits, key=lambda one: one["time"])
    traces = list(encounters(read_fcd(written(tmp_path, "a.xml", as_xml(both))), 100.0))
    assert [len(trace.time) for *_, trace in traces] == [6, 6] * 2
    assert not any(COLLISION(trace) for *_, trace in traces)
    assert max(float(np.abs(trace.acceleration).max()) for *_, trace in traces) == 0.0
    beside = [one | {"y": 0.0 if k < 12 else 3.2} for k, one in enumerate(DRIVE)]
    assert len(list(encounters(read_fcd(written(tmp_path, "b.xml", as_xml(beside))), 100.0))) == 2
    wrong = [one | {"speed": 0.1 * one["speed"]} for one in DRIVE]
    assert len(list(encounters(read_fcd(written(tmp_path, "c.xml", as_xml(wrong))), 100.0))) == 2


def test_recordings_of_few_times_and_of_noise_are_not_cut(tmp_path: Path) -> None:
    """Who stands at both of two times may have moved up between them, and a place is known to half a metre."""
    rng = np.random.Generator(np.random.PCG64(1))
    queue = [row(2.0 * k, name, x + 3.0 * (k > 4), speed=0.0) for k in range(10) for name, x in (("7", 0.0), ("8", 9.0))]
    noisy = [row(float(k), name, x + v * k + 0.5 * rng.standard_normal(), speed=v)
             for k in range(60) for name, x, v in (("7", 0.0, 10.0), ("8", 30.0, 10.0), ("9", 60.0, 0.0))]  # fmt: skip
    unknown = [row(0.1 * k, name, x + 1.2 * k, speed=v) for k in range(40) for name, x, v in (("7", 0.0, 0.0), ("8", 20.0, 12.0))]
    for k, rows in enumerate((queue, noisy, unknown)):
        recording = read_fcd(written(tmp_path, f"{k}.xml", as_xml(rows)))
        assert len(list(pair_traces(recording, 0, 1))) == 1
