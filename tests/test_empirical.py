"""A recorded sample as a law: the density is that of the distribution function, both tails are exact."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.stats import norm

from sbt.config.assemble import assemble
from sbt.config.load import ConfigError, load
from sbt.errors import InputError
from sbt.estimators.surrogate import Coordinates
from sbt.problem.distribution import Distribution
from sbt.problem.empirical import KernelDensity, silverman
from sbt.problem.parameter import Parameter
from sbt.problem.space import ParameterSpace
from sbt.seeds import stream


@pytest.fixture
def speeds(tmp_path):
    values = np.concatenate([stream(1, "v").normal(10, 1, 60), stream(2, "v").normal(20, 2, 40)])
    path = tmp_path / "speeds.csv"
    path.write_text("t,v\n" + "".join(f"{k},{v}\n" for k, v in enumerate(values)))
    return path


def test_one_kernel_is_the_normal_law():
    law, same = KernelDensity(np.full(10, 3.0), 2.0), norm(3.0, 2.0)
    x, q = np.linspace(-9, 15, 25), np.array([1e-12, 1e-3, 0.5, 0.9])
    for name, at in (("cdf", x), ("sf", x), ("logpdf", x), ("ppf", q), ("isf", q)):
        np.testing.assert_allclose(getattr(law, name)(at), getattr(same, name)(at), rtol=1e-7, atol=1e-12)


def test_the_law_of_an_input(speeds):
    law = Distribution.of(kind="empirical", file=str(speeds), column="v")
    p = Parameter("v", 0.0, 40.0, "m/s", law)
    z = np.linspace(-3, 3, 13)
    np.testing.assert_allclose(p.to_normal(p.from_normal(z)), z, atol=1e-6)
    x = np.linspace(0, 40, 20001)
    assert np.trapezoid(np.exp(p.log_density(x)), x) == pytest.approx(1.0, abs=1e-4)
    assert silverman(np.arange(100.0)) == pytest.approx(0.9 * np.arange(100.0).std(ddof=1) * 100**-0.2)
    wide = Distribution.of(kind="empirical", file=str(speeds), column="v", bandwidth=5.0).truncated(0, 40)
    assert wide.cdf(np.array([8.0])) > law.truncated(0, 40).cdf(np.array([8.0]))


def test_a_metamodel_learns_the_value_of_an_input_that_leaps(tmp_path):
    """In its normal score what is linear in the value was a cliff: 3 of 10 intervals were 4 to 7 standard errors too high."""

    def coordinates(name, values):
        (tmp_path / name).write_text("v\n" + "\n".join(map(str, values)))
        law = Distribution.of(kind="empirical", file=str(tmp_path / name), column="v")
        space = ParameterSpace((Parameter("v", 0.0, 80.0, "m/s", law), Parameter("g", 0.0, 1.0)), ((1.0, 0.5), (0.5, 1.0)))
        z = stream(4).standard_normal((500, 2))
        return space.from_normal(z)[:, 0] / 80.0, Coordinates(space)(z)

    slow, fast = stream(1).normal(20.0, 2.0, 190), stream(2).normal(60.0, 1.0, 10)
    value, found = coordinates("two", np.concatenate([slow, fast]))
    assert found.shape == (500, 3)
    np.testing.assert_allclose(found[:, 2], value, atol=1e-4)
    assert coordinates("one", slow)[1].shape == (500, 2)


def test_in_a_configuration_and_what_is_wrong_with_it(speeds):
    def of(**law):
        path = speeds.parent / "c.yaml"
        keys = {"campaign": "estimation", "scenario": "testbed:linear_d2"}
        path.write_text(json.dumps(keys | {"inputs": {"x1": {"distribution": {"kind": "empirical", **law}}}}))
        return assemble(load(path))

    assert of(file="speeds.csv", column="v").scenario.space.parameters[0].distribution.kind == "empirical"
    for wrong, told in (
        ({"file": "none.csv", "column": "v"}, "readable file"), ({"file": "speeds.csv", "column": "w"}, "must have the column w"),
        ({"file": "speeds.csv"}, "takes file, column"), ({"file": "speeds.csv", "column": "v", "bandwidth": 0}, "bandwidth > 0"),
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=told):
            of(**wrong)
    few = speeds.with_name("few.csv")
    few.write_text("v\n1\n2\n")
    with pytest.raises(InputError, match="at least 10"):
        Distribution.of(kind="empirical", file=str(few), column="v")
