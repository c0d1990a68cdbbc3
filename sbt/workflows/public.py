"""The names that `import sbt` offers, where they are defined: for type checkers and editors; `sbt` itself imports them late."""

import sbt.acquisitions as acquisitions
import sbt.campaigns as campaigns
import sbt.metamodels as metamodels
import sbt.metrics as metrics
from sbt.campaigns.settings import CampaignKind
from sbt.errors import InputError, PluginError, RunError, SbtError, StoreError
from sbt.loop.stages import Batch, Campaign, Log, Progress
from sbt.metamodels.prediction import Prediction
from sbt.problem.combination import CombinedRequirement, all_of, any_of
from sbt.problem.distribution import (
    Beta,
    Distribution,
    Empirical,
    Exponential,
    Gumbel,
    LogNormal,
    Normal,
    SciPy,
    Triangular,
    Uniform,
    Weibull,
)
from sbt.problem.metric import Metric
from sbt.problem.parameter import Parameter
from sbt.problem.profile import KnotProfile, RecordedProfile
from sbt.problem.requirement import CriticalInterval, Requirement
from sbt.problem.scenario import LogicalScenario as Scenario
from sbt.problem.scenario import Roles
from sbt.problem.space import ParameterSpace
from sbt.problem.trace import FieldOfView, Trace
from sbt.store.database import PlannedRun
from sbt.workflows.front import Run
from sbt.workflows.front import check_target as check
from sbt.workflows.front import installed as list
from sbt.workflows.front import open_result as open
from sbt.workflows.front import run_campaign as run
from sbt.workflows.front import simulate_scenario as simulate
from sbt.workflows.result import Film, Result

__all__ = [
    "Batch",
    "Beta",
    "Campaign",
    "CampaignKind",
    "CombinedRequirement",
    "CriticalInterval",
    "Distribution",
    "Empirical",
    "Exponential",
    "FieldOfView",
    "Film",
    "Gumbel",
    "InputError",
    "KnotProfile",
    "Log",
    "LogNormal",
    "Metric",
    "Normal",
    "Parameter",
    "ParameterSpace",
    "PlannedRun",
    "PluginError",
    "Prediction",
    "Progress",
    "RecordedProfile",
    "Requirement",
    "Result",
    "Roles",
    "Run",
    "RunError",
    "SbtError",
    "Scenario",
    "SciPy",
    "StoreError",
    "Trace",
    "Triangular",
    "Uniform",
    "Weibull",
    "acquisitions",
    "all_of",
    "any_of",
    "campaigns",
    "check",
    "list",
    "metamodels",
    "metrics",
    "open",
    "run",
    "simulate",
]
