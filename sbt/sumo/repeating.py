"""Runs that SUMO does not always repeat, whoever asks."""

from __future__ import annotations

import re

from sbt.sumo.files import SumoFiles

__all__ = ["unrepeatable"]

_IGNORES = re.compile(rb'\bjmIgnoreFoeProb\s*=\s*["\']([^"\']*)')
_WALKS = re.compile(rb"<(walk|personTrip)\b")
_COMMENT = re.compile(rb"<!--.*?-->", re.DOTALL)


def unrepeatable(files: SumoFiles | None) -> str:
    """Return why runs of these files may differ although inputs and seed are equal; "" where nothing of the kind is known."""
    trees = () if files is None else files.templates
    texts = [_COMMENT.sub(b"", one.opened().read()) for one in trees if one.root[0] != "net"]
    if not any(_ignores(found) for text in texts for found in _IGNORES.findall(text)) or not any(map(_WALKS.search, texts)):
        return ""
    return (
        "vehicle types have jmIgnoreFoeProb and persons walk: at a crossing SUMO draws a random number for each of them, in the"
        " order of their addresses in memory, so that a few runs are other ones in another process"
    )


def _ignores(probability: bytes) -> bool:
    """Return whether a probability is one, or may be as an input."""
    try:
        return float(probability) > 0.0
    except ValueError:
        return True
