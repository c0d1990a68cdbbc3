"""Whether a run is critical: what of it the inputs decide, what the traffic that the seed draws, and what stays open."""

from __future__ import annotations

from dataclasses import dataclass

from sbt.campaigns.settings import Settings
from sbt.campaigns.wording import percent, plural
from sbt.loop.drawn_traffic import DrawnTraffic
from sbt.loop.learner import FittedMetamodel
from sbt.store.history import VALIDATION, History

__all__ = ["OverTraffic", "TrafficDoubt", "over_traffic", "traffic_doubt", "unused_words"]

_FEWEST, _EITHER = 100, 10
"""Runs, and critical and safe ones among them, from which on shares are stated."""


@dataclass(frozen=True)
class OverTraffic:
    """That P(critical) is the mean over the traffic that seeds draw.

    Attributes:
        runs: with what was known of their traffic, from which it was learned.
        chosen: those of them whose seeds were chosen.
    """

    runs: int
    chosen: int

    def sentence(self) -> str:
        """Return it in words."""
        chosen = f"; {plural(self.chosen, 'seed')} were chosen for what they draw, so that their runs count in no rate"
        return (
            f"P(critical) is the mean over the traffic that seeds draw, learned from {plural(self.runs, 'run')} and what was"
            f" known of their traffic before{chosen if self.chosen else ''}."
        )


@dataclass(frozen=True)
class TrafficDoubt:
    """P(critical | inputs) as the mean over the traffic that seeds draw, and the variance of "critical" in three parts.

    Attributes:
        critical_fraction: mean P(critical) over the space and over drawn traffic.
        inputs: share of the variance that is between inputs, whatever the traffic: beyond it a boundary tells nothing.
        traffic: share between the traffics of the same inputs.
        rest: share that is left when both are known: the drivers' imperfection during the run, and what the runs did not teach.
        pairs: of inputs and fresh seeds, over which it was taken.
    """

    critical_fraction: float
    inputs: float
    traffic: float
    rest: float
    pairs: int

    def sentence(self) -> str:
        """Return the shares in words."""
        return (
            f"Whether a run is critical is decided to {percent(self.inputs)} by the inputs and to {percent(self.traffic)} by the"
            f" drawn traffic; {percent(self.rest)} stay open: drivers during the run, and what the runs do not teach. Over"
            f" {self.pairs:,} pairs of inputs and fresh seeds, {percent(self.critical_fraction)} are critical in the mean."
        )


def over_traffic(fitted: FittedMetamodel, history: History) -> OverTraffic | None:
    """Return from how many runs P(critical) was learned as the mean over traffic; None where inputs alone tell it."""
    if fitted.record.over_traffic is None:
        return None
    return OverTraffic(int((history.ok & (history.stage != VALIDATION)).sum()), int((~history.drawn).sum()))


def unused_words(chosen: int) -> str:
    """Return in words that seeds of so many runs were chosen, and P(critical) is not learned from what they draw."""
    were = "was chosen for what it draws" if chosen == 1 else "were chosen for what they draw"
    return (
        f"{plural(chosen, 'seed')} {were}:"
        f" as left-out runs are not surely likelier by that, P(critical) is learned from the inputs of the other runs."
    )


def traffic_doubt(settings: Settings, history: History) -> TrafficDoubt | None:
    """Return the shares; None where seeds are not looked at, or there are fewer than 100 runs, or 10 critical or safe ones."""
    covariates, scenario = settings.covariates, settings.scenario
    runs = history.where((history.stage != VALIDATION) & (history.columns["level"] == 0))
    critical = scenario.requirement.critical_runs(runs)
    if covariates is None or len(runs) < _FEWEST or min(critical.sum(), (~critical).sum()) < _EITHER:
        return None
    drawn = None if settings.learner is None else settings.learner.traffic
    drawn = DrawnTraffic(scenario, settings.seed, covariates) if drawn is None else drawn
    learned = drawn.learned(history)
    if learned is None:
        return None
    p = drawn.table(learned.risk)
    traffic, rest = float(p.var(axis=1, ddof=1).mean()), float((p * (1.0 - p)).mean())
    between = max(float(p.mean(axis=1).var(ddof=1)) - traffic / p.shape[1], 0.0)
    whole = max(between + traffic + rest, 1e-300)
    return TrafficDoubt(float(p.mean()), between / whole, traffic / whole, rest / whole, p.size)
