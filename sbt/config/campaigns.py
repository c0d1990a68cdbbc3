"""What the campaigns are called in a configuration, and what each takes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

__all__ = ["CAMPAIGNS", "CampaignKind"]


@dataclass(frozen=True)
class CampaignKind:
    """What a campaign takes: its default acquisition, its stop rules, and whether it learns where to go.

    Args:
        description: for people.
        acquisition: the default.
        stop: its stop rules with their defaults; None: off unless asked for.
        adaptive: it needs a metamodel.
        methods: values of `acquisition.kind` that are the campaign's own ways to choose a batch, beside
            the installed acquisition functions.
        metamodel: the default one with its settings.
        most_initial: the most runs that the default of `initial` takes.
        batch: default runs per iteration; None: as many as initial.
    """

    description: str
    acquisition: str
    stop: Mapping[str, float | int | None] = field(default_factory=dict)
    adaptive: bool = True
    methods: tuple[str, ...] = ()
    metamodel: Mapping[str, Any] = field(default_factory=lambda: {"kind": "gp", "nu": 2.5, "input_noise": False})
    most_initial: int | None = None
    batch: int | None = None


CAMPAIGNS: Mapping[str, CampaignKind] = {
    "boundary": CampaignKind(
        "identify where critical meets uncritical", "mix", stop={"stable": None, "misclassified": None},
        methods=("mix",),
        metamodel={"kind": "auto", "preset": "quick"},
    ),
    "falsification": CampaignKind(
        "find critical concrete scenarios, and distinct failure modes", "portfolio",
        stop={"failures": None, "modes": None},
        methods=(
            "portfolio", "log_expected_improvement", "probability_of_violation", "lower_confidence_bound", "thompson", "cma_es",
        ),
        most_initial=10, batch=10,
    ),
    "estimation": CampaignKind(
        "probability of a critical scenario under the inputs' distribution", "auto",
        stop={"cov": 0.1}, methods=("auto", "difference", "monte_carlo", "subset"),
    ),
    "coverage": CampaignKind("evenly distributed points: the baseline, and data sets", "even", adaptive=False),
}
"""The campaigns."""
