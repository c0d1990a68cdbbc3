"""What a user's type checker sees of the library; never executed."""

from typing import assert_type

from matplotlib.axes import Axes

import sbt
from sbt.campaigns.boundary import BoundaryConclusion
from sbt.store.records import Validation

scenario = sbt.Scenario(
    "line", [sbt.Parameter("a", 0, 1, "m")], sbt.Requirement("y", high=0.5), evaluate=lambda values, seed: {"y": values["a"]}
)


def drive(values: dict[str, float], seed: int) -> dict[str, float]:
    return {"y": values["a"]}


sbt.Scenario("line", [sbt.Parameter("a", 0, 1, "m")], sbt.Requirement("y", high=0.5), evaluate=drive)
result = sbt.run(campaign="boundary", scenario=scenario, metamodel="gp", budget=20)
assert_type(result, sbt.Result[BoundaryConclusion])
assert_type(result.conclusion, BoundaryConclusion)
assert_type(result.conclusion.validation, Validation | None)
assert_type(result.plot.runs(), Axes)
assert_type(result.sentences(), list[str])
assert_type(sbt.simulate(scenario, {"a": 0.5}), sbt.Run)
assert_type(sbt.simulate(scenario).critical, bool | None)
assert_type(sbt.list("metrics"), dict[str, str])
opened = sbt.open("runs/line", scenario=scenario)
rows = len(opened.frame)

sbt.run(campaign="boundary", scenario=scenario, bugdet=20)  # type: ignore[call-overload]
sbt.simulate(scenario, {"a": 0.5}, sead=1)  # type: ignore[call-arg]
