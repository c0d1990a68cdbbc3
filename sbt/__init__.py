"""Scenario-based testing of automated vehicles on SUMO with probabilistic metamodels.

>>> import sbt
>>> scenario = sbt.Scenario("disc", [sbt.Parameter("a", -1, 1, "m")], sbt.Requirement("gap", high=0.0),
...                         evaluate=lambda values, seed: {"gap": values["a"] ** 2 - 0.5})
>>> sbt.simulate(scenario, {"a": 0.5}).critical
True
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from sbt import testing
    from sbt.workflows.public import (
        Batch,
        Beta,
        Campaign,
        CampaignKind,
        CombinedRequirement,
        CriticalInterval,
        Distribution,
        Empirical,
        Exponential,
        FieldOfView,
        Film,
        Gumbel,
        InputError,
        KnotProfile,
        Log,
        LogNormal,
        Metric,
        Normal,
        Parameter,
        ParameterSpace,
        PlannedRun,
        PluginError,
        Prediction,
        Progress,
        RecordedProfile,
        Requirement,
        Result,
        Roles,
        Run,
        RunError,
        SbtError,
        Scenario,
        SciPy,
        StoreError,
        Trace,
        Triangular,
        Uniform,
        Weibull,
        acquisitions,
        all_of,
        any_of,
        campaigns,
        check,
        list,
        metamodels,
        metrics,
        open,
        run,
        simulate,
    )

_FROM = {
    "sbt.campaigns.settings": ("CampaignKind",),
    "sbt.errors": ("InputError", "PluginError", "RunError", "SbtError", "StoreError"),
    "sbt.loop.stages": ("Batch", "Campaign", "Log", "Progress"),
    "sbt.metamodels.prediction": ("Prediction",),
    "sbt.problem.combination": ("CombinedRequirement", "all_of", "any_of"),
    "sbt.problem.distribution": (
        "Beta", "Distribution", "Empirical", "Exponential", "Gumbel", "LogNormal", "Normal", "SciPy", "Triangular", "Uniform",
        "Weibull",
    ),
    "sbt.problem.parameter": ("Parameter",),
    "sbt.problem.profile": ("KnotProfile", "RecordedProfile"),
    "sbt.problem.requirement": ("CriticalInterval", "Requirement"),
    "sbt.problem.scenario": ("LogicalScenario Scenario", "Metric", "Roles"),
    "sbt.problem.space": ("ParameterSpace",),
    "sbt.problem.trace": ("FieldOfView", "Trace"),
    "sbt.store.database": ("PlannedRun",),
    "sbt.workflows.front": (
        "Run", "check_target check", "installed list", "open_result open", "run_campaign run", "simulate_scenario simulate",
    ),
    "sbt.workflows.result": ("Film", "Result"),
}  # fmt: skip
"""Where the names are defined; `a b`: a is called b here."""
_PARTS = ("acquisitions", "campaigns", "metamodels", "metrics", "testing")
"""Modules that hold the parts by the names of `list`, and the checkers of plug-ins."""
_NAMES = {name.split()[-1]: (module, name.split()[0]) for module, names in _FROM.items() for name in names}

__all__ = [  # noqa: RUF022  (by use)
    "run", "open", "simulate", "list", "check", "Scenario", "Parameter", "ParameterSpace", "Requirement", "CriticalInterval",
    "any_of", "all_of", "CombinedRequirement", "Metric", "Roles", "Trace", "FieldOfView", "Distribution", "Uniform", "Normal",
    "LogNormal", "Exponential", "Gumbel", "Weibull", "Beta", "Triangular", "SciPy",
    "Empirical", "KnotProfile", "RecordedProfile", "Prediction", "Result", "Run", "Film", "Progress",
    "CampaignKind", "Campaign", "Batch", "Log", "PlannedRun", "SbtError", "InputError", "PluginError", "RunError", "StoreError",
    "acquisitions", "campaigns", "metamodels", "metrics", "testing", "__version__",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import what is asked for when it is asked for (PEP 562): nothing heavy before."""
    if name in _PARTS:
        return import_module(f"sbt.{name}")
    if name not in _NAMES:
        from sbt.errors import did_you_mean

        raise AttributeError(f"module 'sbt' has no attribute '{name}'{did_you_mean(name, __all__)}")
    module, attribute = _NAMES[name]
    found = globals()[name] = getattr(import_module(module), attribute)
    return found


def __dir__() -> Any:
    """Return what a user needs."""
    return sorted(__all__)
