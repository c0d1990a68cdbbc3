"""The files that SUMO writes because an input file names them: detectors, mean data, probes, calibrators, devices.

A run must not write beside the user's files, where runs would overwrite each other's: in the copies of input files that
a run uses, these names are replaced by names in a folder of the run.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from xml.sax.saxutils import unescape

__all__ = ["MARKS", "begin_outputs", "collect_outputs", "in_signals", "names_output", "output_names", "run_file"]

_ATTRIBUTES = {
    **dict.fromkeys((
        "inductionLoop", "e1Detector", "instantInductionLoop", "laneAreaDetector", "e2Detector", "entryExitDetector",
        "e3Detector", "edgeData", "laneData", "routeProbe", "vTypeProbe",
    ), "file"),
    "calibrator": "output", "timedEvent": "dest", "param": "value",
}  # fmt: skip
"""Attribute that names the file, by element (SUMO's `additional_file.xsd`)."""
_PARAMETERS = ("device.ssm.file", "device.toc.file")
"""Keys of `<param>` whose value names a file, of whatever it is a parameter."""
_OF_SIGNALS = ("file", "SWARMLOG")
"""The same, where it is a parameter of a signal program (actuated, delay-based, NEMA, swarm)."""
_WITHIN_SIGNALS = ("phase", "param", "condition", "assignment", "function")
"""What stands within a signal program."""
MARKS = (
    *(b"<" + tag.encode() for tag in _ATTRIBUTES if tag != "param"), *(key.encode() for key in _PARAMETERS),
    b'"file"', b"'file'", b"SWARMLOG", b"&#",
)  # fmt: skip
"""A file without any of these names no output; with `&#` any of them may be written otherwise."""
_NOWHERE = ("nul", "NUL", "/dev/null")
_NAMED, _UNNAMED = "outputs", "unnamed_outputs"
"""Folders of what the user's files name, by its whole path, and of the rest."""


def in_signals(tag: str, *, before: bool) -> bool:
    """Return whether an element is a signal program or in one.

    Args:
        tag: of the element.
        before: whether the element before it is.
    """
    return tag == "tlLogic" or (before and tag in _WITHIN_SIGNALS)


def names_output(tag: str, attributes: Mapping[str, str], *, signals: bool) -> bool:
    """Return whether an element names an output.

    Args:
        tag: of the element.
        attributes: of the element, as they are read.
        signals: it is in a signal program.
    """
    if tag != "param":
        return tag in _ATTRIBUTES
    return (key := attributes.get("key")) in _PARAMETERS or (signals and key in _OF_SIGNALS)


def output_names(tag: str, start_tag: bytes) -> Iterator[tuple[int, int, str]]:
    """Yield start, end (with its quotes) and value of the attribute of a start tag that names an output (`names_output`)."""
    for match in re.finditer(rb"\s%s\s*=\s*(\"[^\"]*\"|'[^']*')" % _ATTRIBUTES[tag].encode(), start_tag):
        value = unescape(match.group(1)[1:-1].decode(), {"&quot;": '"', "&apos;": "'"})
        if value and value not in _NOWHERE:
            yield match.start(1), match.end(1), value


def run_file(folder: Path, beside: Path, name: str) -> Path:
    """Return where a run in `folder` writes the output `name` of the file `beside`, and make its folder.

    Outputs of the same name in different folders of the user stay apart.
    """
    wanted = (beside.parent / name).resolve()
    target = folder.resolve() / _NAMED / wanted.relative_to(wanted.anchor)
    target.parent.mkdir(parents=True, exist_ok=True)
    return target


def begin_outputs(folder: Path) -> Path:
    """Remove the outputs of the last run in a folder, and return where outputs go that no file names."""
    for name in (_NAMED, _UNNAMED):
        shutil.rmtree(folder / name, ignore_errors=True)
    (folder / _UNNAMED).mkdir(parents=True)
    return folder / _UNNAMED


def collect_outputs(folder: Path, into: Path) -> None:
    """Copy the outputs of the last run in a folder, with the folders in which they differ; nothing where there are none."""
    for name in (_NAMED, _UNNAMED):
        found = [path for path in (folder / name).rglob("*") if path.is_file()]
        common = Path(os.path.commonpath([path.parent for path in found])) if found else folder
        for path in found:
            copy = into / path.relative_to(common)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, copy)
