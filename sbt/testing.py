"""Contract checks for plug-ins: call them from your own tests, or through `sumo-sbt check`.

Each check runs the laws that campaigns rely on and raises `ContractError` with the rule and the value
that broke it; it returns nothing where all hold.
"""

from sbt.workflows.contracts import (
    ContractError,
    check_acquisition,
    check_campaign,
    check_metamodel,
    check_metric,
    check_sampler,
    check_scenario,
)
from sbt.workflows.pinning import Pinned, PinnedRun
from sbt.workflows.plausibility import check_physics

__all__ = [
    "ContractError",
    "Pinned",
    "PinnedRun",
    "check_acquisition",
    "check_campaign",
    "check_metamodel",
    "check_metric",
    "check_physics",
    "check_sampler",
    "check_scenario",
]
