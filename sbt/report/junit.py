"""The verdict of a campaign as JUnit XML, the form in which CI systems show test results."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

from sbt.problem.plain import JsonMapping

__all__ = ["write_junit"]


def write_junit(path: Path, result: JsonMapping, *, fail_on_critical: bool = False) -> None:
    """Write one test suite with a case for each verdict: the runs, the gate, critical runs where they are to fail.

    A gate that is undecided is a failure of its own type: it did not pass.

    Args:
        path: of the file.
        result: what `run --json` prints.
        fail_on_critical: add a case that fails where a run was critical.
    """
    name = f"{result['campaign']} of {result['scenario']}"
    summary = f"{result['failed']} of {result['runs']} runs failed"
    too_many = "failed_runs" if 2 * result["failed"] > result["runs"] else None
    cases: list[tuple[str, str | None, str]] = [("runs", too_many, summary)]
    gate = result["conclusion"].get("gate")
    if gate is not None:
        cases.append(("gate", None if gate["verdict"] == "pass" else gate["verdict"], gate["statement"]))
    if fail_on_critical:
        cases.append(("no critical run", "critical" if result["critical"] else None, f"{result['critical']} runs were critical"))
    failures = sum(kind is not None for _, kind, _ in cases)
    seconds = f"{sum(result['seconds'][name] for name in ('simulate', 'fit', 'propose')):.3f}"
    suite = ET.Element("testsuite", name=name, tests=str(len(cases)), failures=str(failures), errors="0", time=seconds)
    for title, kind, statement in cases:
        case = ET.SubElement(suite, "testcase", classname=name, name=title)
        if kind is not None:
            ET.SubElement(case, "failure", type=kind, message=statement)
        else:
            ET.SubElement(case, "system-out").text = statement
    path.parent.mkdir(parents=True, exist_ok=True)
    ET.ElementTree(suite).write(path, encoding="utf-8", xml_declaration=True)
