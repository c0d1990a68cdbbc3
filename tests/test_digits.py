"""Values of inputs are told apart wherever they are written: digits follow from the range, and from how sure an edge is."""

from __future__ import annotations

import html
import re

import numpy as np
import pytest

import sbt
from sbt.campaigns.place import BoundaryPlace, Cut, Stretch
from sbt.campaigns.wording import NOTHING, input_value, input_widths, narrow_digits
from sbt.cli.conclusion import conclusion_lines
from sbt.problem.parameter import Parameter
from sbt.report.explorer import explorer_data
from sbt.report.tables import critical_table
from sbt.report.words import Findings
from sbt.seeds import stream
from sbt.store.database import Store
from tests.test_explorer import numbers

RANGES = [(0.0, 1.0), (3600.0, 3610.0), (691000.0, 691010.0), (100.0, 100.5), (-20.0, -19.9), (0.0, 5000.0), (1e9, 1e9 + 1.0)]


@pytest.mark.parametrize(("low", "high"), RANGES)
@pytest.mark.parametrize("digits", [3, 4, 5])
def test_rounding_is_small_beside_the_range_and_beside_how_sure_a_value_is(low: float, high: float, digits: int):
    width = high - low
    for value in (low + width * stream(1, "value").random(200)).tolist():
        assert abs(float(input_value(value, width, digits)) - value) <= 10.0 ** (1 - digits) * width
        assert abs(float(input_value(value, width, digits, sure=width / 800)) - value) <= width / 800


def test_values_of_ranges_from_zero_read_as_ever():
    for width in (1.0, 8.0, 40.0, 900.0):
        for value in (width * stream(2, "value").random(200)).tolist():
            assert input_value(value, width) == f"{value:.3g}"
    assert input_value(0.33900000001, 1.0) == "0.339"
    assert [input_value(each) for each in (3605.6249, 12000.0, None, "bus")] == ["3606", "12000", NOTHING, "bus"]


def test_lines_at_different_places_are_all_told():
    cuts = tuple(Cut(at, (Stretch(0.0, edge),), 0.001) for at, edge in ((3600.7, 0.43), (3602.4, 0.26), (3602.41, 0.08)))
    said = BoundaryPlace(("b", "depart"), 0.0, 1.0, cuts, {"x": 691004.27}, {}).words({}, {"depart": 10.0, "x": 10.0})
    assert "below 0.43 at depart 3600.7" in said
    assert "below 0.26 at 3602.4" in said
    assert "below 0.08 at 3602.41" in said
    assert said.endswith("in the section with x 691004.3")


NARROW = sbt.Scenario(
    "dep", [Parameter("depart", 691000, 691010, "s"), Parameter("b", 0, 1)], sbt.Requirement("m", high=-1.0),
    evaluate=lambda v, seed: {"m": -(v["depart"] - 691000) / 5 + v["b"]},
)  # fmt: skip
"""Critical where depart is above 691005 + 5 b."""


@pytest.mark.parametrize("campaign", ["boundary", "falsification"])
def test_what_campaigns_and_reports_tell_of_a_narrow_range_is_true(tmp_path, campaign: str):
    result = sbt.run(
        campaign=campaign, scenario=NARROW, budget=40, initial=10, batch=10, seed=0, store=tmp_path / "s", executor="serial",
        metamodel="gp", judges=[],
    )  # fmt: skip
    history, page = result.history, html.unescape(result.report().read_text(encoding="utf-8"))
    assert not re.search(r"\d\.\d+e\+0\d", page)
    widths = input_widths(history)
    assert widths["depart"] <= 10.0
    table = critical_table(history, NARROW.requirement, "replay RUN")
    column = table.columns.index("depart")
    assert all(abs(float(row[column].text) - row[column].key) <= 0.01 for row in table.rows)
    if campaign == "boundary":
        edges = re.findall(r"above ([\d.]+) s at (?:b )?([\d.]+)", result.sentences()[0])
        assert len(edges) == 3
        assert all(abs(float(edge) - 691005.0 - 5.0 * float(at)) < 0.06 for edge, at in edges)
        return
    told = next(line for line in conclusion_lines(result.summary) if "mode 1" in line)
    mode = result.conclusion.failure_modes[0]
    assert abs(float(re.search(r"depart ([\d.]+) s", told)[1]) - mode.inputs["depart"]) <= 0.1
    assert narrow_digits(mode.inputs, {"depart": 1e6, "b": 1.0}) == {}
    with Store.read(tmp_path / "s") as store:
        data = explorer_data(Findings.of(store, NARROW, None), NARROW, None, np.ones(2))
    depart = data["inputs"][0]
    assert np.abs(numbers(data["x"][0]).astype(float) + depart["origin"] - history.x[:, 0]).max() < 1e-4
    assert depart["digits"] >= 8
