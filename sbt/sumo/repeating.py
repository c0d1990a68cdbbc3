"""Runs that SUMO does not always repeat, whoever asks."""

from __future__ import annotations

import re

from sbt.sumo.files import SumoFiles

__all__ = ["unrepeatable"]

_IGNORES = re.compile(rb'\bjmIgnoreFoeProb\s*=\s*["\'](?!\s*0*\.?0*\s*["\'])')
_WALKS = re.compile(rb"<(person|personFlow)\b")


def unrepeatable(files: SumoFiles | None) -> str:
    """Return why runs of these files may differ although inputs and seed are equal; "" where nothing of the kind is known."""
    texts = [one.opened().read() for one in files.templates if one.root[0] != "net"] if files is not None else []
    if not (any(map(_IGNORES.search, texts)) and any(map(_WALKS.search, texts))):
        return ""
    return (
        "vehicle types have jmIgnoreFoeProb and persons walk: at a crossing SUMO draws a random number for each of them, in the"
        " order of their addresses in memory, so that a few runs are other ones in another process"
    )
