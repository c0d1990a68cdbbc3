"""How many runs lie on each side of the requirement, as far as a sentence depends on it."""

from __future__ import annotations

from sbt.campaigns.wording import plural
from sbt.loop.stages import Facts

__all__ = ["all_critical", "few_of_a_side", "met", "none_critical"]

_FEW = 5  # runs of a side, below which edges are told with reserve, however sure the metamodel is


def few_of_a_side(facts: Facts) -> str:
    """Return in words that the boundary rests on few runs of one of its sides; empty where it does not."""
    critical = facts.requirement.critical_runs(facts.history.training)
    sides = {"critical": int(critical.sum()), "uncritical": int((~critical).sum())}
    side = min(sides, key=lambda name: sides[name])
    if not sides[side]:
        return f"no {side} run tells of it"
    return f"only {plural(sides[side], f'{side} run')} tell{'s' * (sides[side] == 1)} of it" if sides[side] < _FEW else ""


def all_critical(facts: Facts) -> bool:
    """Return whether every run that gave a metric was critical."""
    ok = facts.history.ok
    return bool(ok.any() and facts.requirement.critical_runs(facts.history)[ok].all())


def none_critical(facts: Facts) -> bool:
    """Return whether there are runs with a metric, and none of them was critical."""
    return bool(facts.history.ok.any() and not facts.requirement.critical_runs(facts.history).any())


def met(facts: Facts) -> str:
    """Return in words how many critical runs there are; empty for none."""
    n = int(facts.requirement.critical_runs(facts.history).sum())
    return f"{plural(n, 'critical run')} {'was' if n == 1 else 'were'} met" if n else ""
