"""Estimation: the probability of a critical scenario under the inputs' distribution, with an honest interval."""

from __future__ import annotations

from typing import Any

import numpy as np

from sbt.campaign import Campaign, Fit, Log
from sbt.campaigns.parts import Settings
from sbt.campaigns.sequential import SequentialStage, counted_batches
from sbt.estimators.intervals import combined

__all__ = ["recipe"]


def recipe(settings: Settings) -> Campaign:
    """Return the campaign."""

    def conclude(log: Log) -> tuple[dict[str, Any], Fit | None]:
        batches = counted_batches(log, settings)
        if not batches:
            return {"probability": None, "low": 0.0, "high": 1.0}, None
        c = combined(batches)
        return {"probability": c.value, "low": c.limit(.975, side=-1), "high": c.limit(.975, side=1), "cov": c.std_error / c.value if c.value else None,
            "hits": float(sum(b.critical.sum() for b in batches)), "batches": len(batches), "effective_sample_size": c.effective_sample_size}, None

    return Campaign((SequentialStage(settings),), conclude)
