"""How many runs lie on each side of the requirement, as far as a sentence depends on it."""

from __future__ import annotations

import numpy as np

from sbt.campaigns.wording import plural
from sbt.loop.stages import Facts
from sbt.store.history import VALIDATION

__all__ = ["all_critical", "few_of_a_side", "met", "none_critical", "safe_runs"]

_FEW = 5  # runs of a side, below which edges are told with reserve, however sure the metamodel is


def few_of_a_side(facts: Facts, *, pairs: bool = False) -> str:
    """Return in words that the boundary rests on few different inputs of one of its sides; empty where it does not.

    `pairs`: P(critical) was learned from runs of chosen seeds, too.
    """
    history = facts.history
    training = history.where(history.ok & (history.stage != VALIDATION)) if pairs else history.training
    critical = facts.requirement.critical_runs(training)
    sides = {name: len(np.unique(training.x[rows], axis=0)) for name, rows in (("critical", critical), ("uncritical", ~critical))}
    side = min(sides, key=lambda name: sides[name])
    n = sides[side]
    if not n:
        return f"no {side} run tells of it"
    again = " (one and its repetitions)" if n == 1 and int((critical == (side == "critical")).sum()) > 1 else ""
    return f"only {plural(n, f'{side} run')}{again} tell{'s' * (n == 1)} of it" if n < _FEW else ""


def all_critical(facts: Facts) -> bool:
    """Return whether every run that gave a metric was critical."""
    ok = facts.history.ok
    return bool(ok.any() and facts.requirement.critical_runs(facts.history)[ok].all())


def none_critical(facts: Facts) -> bool:
    """Return whether there are runs with a metric, and none of them was critical."""
    return bool(facts.history.ok.any() and not facts.requirement.critical_runs(facts.history).any())


def safe_runs(facts: Facts) -> int:
    """Return how many runs gave a metric and were not critical."""
    return int((facts.history.ok & ~facts.requirement.critical_runs(facts.history)).sum())


def met(facts: Facts) -> str:
    """Return in words how many critical runs there are; empty for none."""
    n = int(facts.requirement.critical_runs(facts.history).sum())
    return f"{plural(n, 'critical run')} {'was' if n == 1 else 'were'} met" if n else ""
