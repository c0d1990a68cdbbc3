"""SUMO's car-following and lane-change models and their vType attributes: the settings of an ego of kind `sumo`.

SUMO silently ignores attributes that a model does not have; with these tables, misspelt and misplaced ones are
refused. Source: SUMO's documentation, "Definition of Vehicles, Vehicle Types, and Routes" and "Car-Following Models".
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from sbt.errors import InputError, did_you_mean
from sbt.sumo.formatting import format_number

__all__ = ["CAR_FOLLOWING", "DEFAULT_LANE_CHANGE", "LANE_CHANGE", "SUBLANE", "known_attributes", "unit_of", "vtype_attributes"]

DEFAULT_LANE_CHANGE = "LC2013"
SUBLANE = "SL2015"
"""The sublane model; it changes lanes only with SUMO's option --lateral-resolution."""
_COMMON = {
    "minGap": "m", "accel": "m/s^2", "decel": "m/s^2", "emergencyDecel": "m/s^2", "apparentDecel": "m/s^2", "tau": "s",
    "maxSpeed": "m/s", "speedFactor": "", "speedDev": "", "actionStepLength": "s", "impatience": "", "startupDelay": "s",
    "length": "m", "width": "m",
    "jmCrossingGap": "m", "jmIgnoreKeepClearTime": "s", "jmDriveAfterYellowTime": "s", "jmDriveAfterRedTime": "s",
    "jmDriveRedSpeed": "m/s", "jmIgnoreFoeSpeed": "m/s", "jmIgnoreFoeProb": "", "jmIgnoreJunctionFoeProb": "",
    "jmSigmaMinor": "", "jmTimegapMinor": "s", "jmStoplineGap": "m", "jmExtraGap": "m",
}  # fmt: skip
_SIGMA = {"sigma": "", "sigmaStep": "s"}
_IDM = {"delta": "", "stepping": "s"}
CAR_FOLLOWING: Mapping[str, Mapping[str, str]] = {
    "Krauss": _SIGMA, "KraussOrig1": _SIGMA, "KraussPS": _SIGMA, "SmartSK": {"sigma": ""},
    "Daniel1": {"sigma": ""}, "PWagner2009": {"sigma": "", "tauLast": "s", "apProb": ""}, "BKerner": {"k": "", "phi": ""},
    "IDM": _IDM, "IDMM": _IDM | {"adaptFactor": "", "adaptTime": "s"},
    "EIDM": _IDM | {
        "tpreview": "s", "tPersDrive": "s", "treaction": "s", "tPersEstimate": "s", "ccoolness": "", "sigmaleader": "",
        "sigmagap": "", "sigmaerror": "", "jerkmax": "m/s^3", "epsilonacc": "m/s^2", "taccmax": "s", "Mflatness": "",
        "Mbegin": "", "maxvehpreview": "", "vehdynamics": "",
    },
    "Wiedemann": {"security": "", "estimation": ""},
    "W99": {"cc1": "s", "cc2": "m", "cc3": "s", "cc4": "m/s", "cc5": "m/s", "cc6": "1e-4 rad/s", "cc7": "m/s^2",
            "cc8": "m/s^2", "cc9": "m/s^2"},
    "ACC": dict.fromkeys((
        "speedControlGain", "gapClosingControlGainSpeed", "gapClosingControlGainSpace", "gapControlGainSpeed",
        "gapControlGainSpace", "collisionAvoidanceGainSpace", "collisionAvoidanceGainSpeed"), ""),
    "CACC": dict.fromkeys((
        "speedControlGainCACC", "gapClosingControlGainGap", "gapClosingControlGainGapDot", "gapControlGainGap",
        "gapControlGainGapDot", "collisionAvoidanceGainGap", "collisionAvoidanceGainGapDot"), ""),
}  # fmt: skip
"""Car-following models: their specific attributes and units, besides the common ones. Two documented models are missing:
SUMO 1.28 does not know KraussAB, and Rail does not support ballistic integration."""
_LC_COMMON = dict.fromkeys((
    "lcStrategic", "lcCooperative", "lcSpeedGain", "lcKeepRight", "lcOvertakeRight", "lcLookaheadLeft", "lcSpeedGainRight",
    "lcSpeedGainLookahead", "lcCooperativeRoundabout", "lcCooperativeSpeed", "lcAssertive", "lcSigma",
    "lcKeepRightAcceptanceTime", "lcOvertakeDeltaSpeedFactor"), "")  # fmt: skip
LANE_CHANGE: Mapping[str, Mapping[str, str]] = {
    "LC2013": _LC_COMMON,
    "SL2015": _LC_COMMON | {
        "lcSublane": "", "lcPushy": "", "lcPushyGap": "m", "lcImpatience": "", "lcTimeToImpatience": "s", "lcAccelLat": "m/s^2",
        "lcTurnAlignmentDistance": "m", "lcMaxSpeedLatStanding": "m/s", "lcMaxSpeedLatFactor": "", "lcLaneDiscipline": "",
    },
    "DK2008": {},
}  # fmt: skip
"""Lane-change models: their attributes and units."""


def known_attributes(model: str, lane_change: str) -> dict[str, str]:
    """Return the attributes of a vehicle with these two models, with their units.

    Raises:
        InputError: there is no such model.
    """
    return {**_COMMON, **_entry("model", CAR_FOLLOWING, model), **_entry("lane_change", LANE_CHANGE, lane_change)}


def unit_of(name: str) -> str:
    """Return the unit of an attribute; "" if it is dimensionless or unknown."""
    tables = (_COMMON, *CAR_FOLLOWING.values(), *LANE_CHANGE.values())
    return next((table[name] for table in tables if name in table), "")


def vtype_attributes(settings: Mapping[str, Any]) -> dict[str, str]:
    """Return the vType attributes for the settings of an ego of kind `sumo`.

    `model` and `lane_change` (SUMO's `carFollowModel` and `laneChangeModel`) select the models, by default Krauss and LC2013;
    `lane_change` may also be true or false.

    Raises:
        InputError: a model is unknown, the models do not have an attribute, or its value is not a finite number.

    >>> vtype_attributes({"model": "IDM", "tau": 1.2})
    {'carFollowModel': 'IDM', 'laneChangeModel': 'LC2013', 'tau': '1.2'}
    """
    aliases = {"carFollowModel": "model", "laneChangeModel": "lane_change"}
    given = {aliases.get(name, name): value for name, value in settings.items()}
    model, lane_change = str(given.pop("model", "Krauss")), given.pop("lane_change", DEFAULT_LANE_CHANGE)
    lane_change = DEFAULT_LANE_CHANGE if isinstance(lane_change, bool) else str(lane_change)  # true, false: whether, not how
    known = known_attributes(model, lane_change)
    for name, value in given.items():
        if name not in known:
            hint = did_you_mean(name, known)
            owners = [m for m, own in {**CAR_FOLLOWING, **LANE_CHANGE}.items() if name in own]
            of = f"; it belongs to {', '.join(owners)}" if owners else hint
            rule = f"ego settings of kind sumo must be vType attributes of {model} or {lane_change}"
            raise InputError(f"{rule}, but got '{name}'{of}")
        if not _finite(value):
            raise InputError(f"ego.{name} must be a finite number, but got {value!r}")
    return {"carFollowModel": model, "laneChangeModel": lane_change} | {
        name: value if isinstance(value, str) else format_number(value) for name, value in given.items()
    }


def _entry(key: str, table: Mapping[str, Mapping[str, str]], name: str) -> Mapping[str, str]:
    if name not in table:
        raise InputError(f"ego.{key} must be one of SUMO's {', '.join(table)}, but got '{name}'{did_you_mean(name, table)}")
    return table[name]


def _finite(value: Any) -> bool:
    try:
        return not isinstance(value, bool | np.bool_) and math.isfinite(float(value))
    except (TypeError, ValueError):
        return False
