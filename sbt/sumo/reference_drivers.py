"""Reference drivers for judging failures: the four models around UN Regulation 157 (ALKS).

They say what a driver could have avoided by braking: a competent and careful human driver (CC), the regulation's minimum
(Reg157), Responsibility-Sensitive Safety (RSS) and the Fuzzy Safety Model (FSM). All of them keep their lane and their speed
until they recognise danger, react after a reaction time, and then only brake. They measure without noise.

Sources: UN Regulation 157, annex 4, appendix 3 (CC) and paragraph 5.2.5.2 (minimum); Shalev-Shwartz, Shammah and Shashua
(2017), arXiv 1708.06374 (RSS); Mattas et al. (2020), doi 10.1016/j.aap.2020.105794 (FSM). What these leave open is as in the
public reference implementation ec-jrc/JRC-FSM, or a named constant here. `docs/reference_drivers.md` compares the two.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Protocol

import numpy as np

from sbt.errors import InputError
from sbt.metrics.rss import Rss
from sbt.sumo.actors import Action, State
from sbt.sumo.others_ahead import WANDERING, OthersAhead, Seen

__all__ = [
    "CC_HUMAN", "FSM", "REG157", "RSS", "FuzzySafety", "HumanDriver", "MinimumRequirement", "ReferenceDriver", "ReferenceModel",
    "ResponsibilitySensitive",
]  # fmt: skip

FULL_BRAKING = 0.774 * 9.81
"""Full braking on a dry road (m/s^2): regulation 157."""
JERK = 12.65
"""Rate at which the braking grows (m/s^3): full braking in 0.6 s, regulation 157."""
NOTICED = 2.0
"""Braking needed for a road user in the own lane from which on a driver reacts (m/s^2): beyond a comfortable one."""
CRUISING = 1.0
"""Largest acceleration without danger (m/s^2), as in the reference implementation."""
STANDING = 2.0
"""Smallest gap behind a standing road user (m): the smallest following distance of regulation 157."""
_REACHED = 0.1
"""Difference to the set speed at which it is reached (m/s)."""
_NONE = 1e-9


class ReferenceModel(Protocol):
    """When one of the models recognises danger, and how it brakes then."""

    reaction_time: float
    release: float
    jerk: float

    def braking_for(self, own: State, seen: Seen, already: bool) -> float:
        """Return the deceleration that it wants because of a road user (m/s^2); 0: no danger.

        Args:
            own: its own state.
            seen: the road user.
            already: it brakes already.
        """
        ...

    def distance(self, speed: float) -> float:
        """Return the gap that it keeps at a speed (m)."""
        ...


@dataclass(frozen=True)
class HumanDriver:
    """The competent and careful human driver of regulation 157.

    Args:
        wandering: movement towards the path from which on a car is perceived as cutting in (m); None: only a car that
            overlaps the path laterally is, and at once, as in the maps of the reference implementation.
        evaluation: time for which the risk of a cut-in is evaluated (s).
        ttc: time to collision up to which a cut-in is critical (s).
        reaction_time: from recognising to braking (s).
        release: deceleration meanwhile, the foot off the accelerator (m/s^2).
        jerk: rate at which the braking grows (m/s^3).
        braking: largest deceleration (m/s^2).
        headway: gap that it keeps (s).
    """

    wandering: float | None = WANDERING
    evaluation: float = 0.4
    ttc: float = 2.0
    reaction_time: float = 0.75
    release: float = 0.4
    jerk: float = JERK
    braking: float = FULL_BRAKING
    headway: float = 2.0

    def braking_for(self, own: State, seen: Seen, already: bool) -> float:
        """Return full braking for a cut-in with a short TTC, and for a road user in the lane that needs more than comfort."""
        in_path = seen.clearance <= 0.0
        cuts_in = self.wandering is not None and seen.approach > 0.0 and seen.wandered >= self.evaluation - _NONE
        if not (in_path or cuts_in):
            return 0.0
        late = seen.time_to_collision() <= self.ttc
        hard = in_path and seen.needed_braking(own.speed) >= NOTICED
        goes_on = already and (seen.closing > 0.0 or seen.deceleration > 0.0)
        return self.braking if late or hard or goes_on else 0.0

    def distance(self, speed: float) -> float:
        """Return the gap that it keeps at a speed (m)."""
        return self.headway * speed


@dataclass(frozen=True)
class MinimumRequirement:
    """What regulation 157 requires at least of a system (paragraph 5.2.5.2).

    Args:
        lateral: distance up to which a car beside the path counts as cutting in (m).
        reaction_time: from recognising to braking (s).
        braking: deceleration (m/s^2), reached at once.
        reserve: added to the critical TTC, closing / (2 braking) + reaction_time (s).
        headway: gap that it keeps (s).
    """

    lateral: float = 0.5
    reaction_time: float = 0.35
    braking: float = 6.0
    reserve: float = 0.1
    headway: float = 2.0
    release: ClassVar[float] = 0.0
    jerk: ClassVar[float] = math.inf

    def braking_for(self, own: State, seen: Seen, already: bool) -> float:
        """Return the braking where the TTC is short, or a road user that did not cut in needs more than comfort."""
        if seen.clearance > self.lateral:
            return 0.0
        late = seen.time_to_collision() <= 0.5 * seen.closing / self.braking + self.reaction_time + self.reserve
        leads = seen.clearance <= 0.0 and (not seen.entered or seen.deceleration > 0.0)
        hard = leads and (seen.needed_braking(own.speed) >= NOTICED or (already and seen.closing > 0.0))
        return self.braking if late or hard else 0.0

    def distance(self, speed: float) -> float:
        """Return the gap that it keeps at a speed (m)."""
        return self.headway * speed


@dataclass(frozen=True)
class ResponsibilitySensitive:
    """Responsibility-Sensitive Safety: danger where both the longitudinal and the lateral distance are unsafe.

    Args:
        reaction_time: of its formulas, and from recognising to braking (s).
        accel: it may accelerate meanwhile (m/s^2).
        expected_braking: of both road users, in its formulas (m/s^2).
        lateral_accel: of the other (m/s^2).
        lateral_margin: smallest lateral distance (m).
        jerk: rate at which the braking grows (m/s^3).
        braking: largest deceleration (m/s^2).
    """

    reaction_time: float = 0.75
    accel: float = 3.0
    expected_braking: float = 6.0
    lateral_accel: float = 1.0
    lateral_margin: float = 0.3
    jerk: float = JERK
    braking: float = FULL_BRAKING
    release: ClassVar[float] = 0.0

    def braking_for(self, own: State, seen: Seen, already: bool) -> float:
        """Return full braking where both distances are unsafe."""
        rt = self.reaction_time
        if seen.gap >= self._rules.same_direction(own.speed, seen.speed):
            return 0.0
        sideways, grown = abs(seen.approach), abs(seen.approach) + self.lateral_accel * rt
        across = self.lateral_margin + 0.5 * (sideways + grown) * rt + 0.5 * grown**2 / self.lateral_accel
        return self.braking if seen.clearance < across else 0.0

    def distance(self, speed: float) -> float:
        """Return the gap that it keeps at a speed (m): safe also after the other has braked for the reaction time."""
        rt, b = self.reaction_time, self.expected_braking
        return float(self._rules.same_direction(speed, max(speed - rt * b, 0.0))) + 0.5 * b * rt**2

    @cached_property
    def _rules(self) -> Rss:
        """The parameters of its safe longitudinal distance."""
        return Rss(self.reaction_time, self.accel, self.expected_braking, self.expected_braking)


@dataclass(frozen=True)
class FuzzySafety:
    """The Fuzzy Safety Model: brakes early and mildly where a distance is uncomfortable, hard where it is critical.

    Args:
        reaction_time: of its formulas, and from recognising to braking (s).
        comfort: braking that a safe distance allows for (m/s^2).
        hard: braking that an unsafe distance needs (m/s^2).
        others_braking: largest braking of the other (m/s^2).
        margin: gap at standstill (m).
        safe_margin: added to it for a safe distance (m).
        lateral_reserve: time by which the other must enter the path before the ego has passed it (s).
        jerk: rate at which the braking grows (m/s^3).
        braking: largest deceleration (m/s^2).
    """

    reaction_time: float = 0.75
    comfort: float = 4.0
    hard: float = 6.0
    others_braking: float = 7.0
    margin: float = 2.0
    safe_margin: float = 2.0
    lateral_reserve: float = 0.1
    jerk: float = JERK
    braking: float = FULL_BRAKING
    release: ClassVar[float] = 0.0

    def braking_for(self, own: State, seen: Seen, already: bool) -> float:
        """Return the braking in proportion to the critical metric, or else to the proactive one."""
        if seen.clearance > 0.0 and not self._enters(own, seen):
            return 0.0
        critical = self.critical(seen.gap, own.speed, seen.speed, own.acceleration)
        if critical > _NONE:
            return min(self.comfort + critical * (self.hard - self.comfort), self.braking)
        proactive = self.proactive(seen.gap, own.speed, seen.speed)
        return proactive * self.comfort if proactive > _NONE else 0.0

    def _enters(self, own: State, seen: Seen) -> bool:
        """Return whether a road user beside the path enters it before the ego has passed."""
        if seen.approach <= 0.0:
            return False
        if seen.closing == 0.0:
            return True
        passed = (seen.gap + 2.0 * own.length) / seen.closing
        return seen.clearance / seen.approach <= passed + self.lateral_reserve

    def proactive(self, gap: float, own: float, other: float) -> float:
        """Return the proactive fuzzy metric, 0 (safe) to 1 (unsafe), of a gap (m) and two speeds (m/s)."""
        apart = gap - self.margin
        common = own * self.reaction_time - 0.5 * other**2 / self.others_braking
        safe, unsafe = common + 0.5 * own**2 / self.comfort + self.safe_margin, common + 0.5 * own**2 / self.hard
        return _between(apart, safe, unsafe)

    def critical(self, gap: float, own: float, other: float, acceleration: float) -> float:
        """Return the critical fuzzy metric, 0 to 1, of a gap (m), two speeds (m/s) and the own acceleration (m/s^2)."""
        if own <= other:
            return 0.0
        rt, a = self.reaction_time, max(acceleration, -self.comfort)
        later = own + rt * a
        if later < other:
            return 1.0 if gap < 0.5 * (own - other) ** 2 / abs(acceleration) else 0.0
        covered, closing = (own + 0.5 * a * rt - other) * rt, later - other
        return _between(gap, covered + 0.5 * closing**2 / self.comfort, covered + 0.5 * closing**2 / self.hard)

    def distance(self, speed: float) -> float:
        """Return the gap that it keeps at a speed (m)."""
        own, other = 0.5 * speed**2 / self.comfort, 0.5 * speed**2 / self.others_braking
        return speed * self.reaction_time + own - other + self.safe_margin + self.margin


def _between(gap: float, safe: float, unsafe: float) -> float:
    """Return 0 from the safe distance on, 1 below the unsafe one, linear between."""
    if gap > safe:
        return 0.0
    return 1.0 if gap < unsafe or safe <= unsafe else (safe - gap) / (safe - unsafe)


class ReferenceDriver:
    """A controller by one of the models: keeps lane and speed, and brakes for danger after its reaction time.

    Without danger it keeps the set speed, whoever is ahead. Below it, it follows at the gap that its model keeps, with at most
    1 m/s^2 either way. After danger it keeps its speed; once it has not closed on anybody in its path for `recovery`, it
    drives on, and reacts anew to the next danger.

    Args:
        model: when it brakes, and how.
        set_speed: cruising speed (m/s).
        recovery: time without danger, and without closing on anybody in the path, after which it drives on (s).
    """

    def __init__(self, model: ReferenceModel, set_speed: float, recovery: float = 2.0):
        self._model, self._set_speed, self._recovery = model, set_speed, recovery
        wandering = getattr(model, "wandering", None)
        self._others = OthersAhead(WANDERING if wandering is None else wandering)
        self._alert = self._calm = self._braking = 0.0
        self._aware = False

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        """Return the acceleration over the next step."""
        model, dt = self._model, own.step
        seen = self._others.look(t, own, others)
        already = self._braking > 0.0
        wanted = max((model.braking_for(own, each, already) for each in seen), default=0.0)
        if wanted > 0.0:
            self._aware, self._calm = True, 0.0
            if self._alert < model.reaction_time - _NONE:
                self._alert += dt
                self._braking = model.release
            else:
                self._braking = min(self._braking + model.jerk * dt, wanted)
            return Action(-self._braking)
        self._braking = 0.0
        if self._aware:
            closes = any(each.clearance <= 0.0 and each.closing > 0.0 for each in seen)
            self._calm = 0.0 if closes else self._calm + dt
            if self._calm < self._recovery - _NONE:
                return Action(0.0)
            self._aware, self._alert = False, 0.0
        return Action(self._cruise(own, seen))

    def _cruise(self, own: State, seen: list[Seen]) -> float:
        """Return the acceleration without danger: at the set speed it waits for danger, below it it follows comfortably."""
        missing = self._set_speed - own.speed
        wanted = min(max(0.4 * missing, -CRUISING), CRUISING)
        if missing <= _REACHED:
            return wanted
        for each in seen:
            if each.clearance < 0.0:
                kept = max(self._model.distance(own.speed), STANDING)
                wanted = min(wanted, max(0.1 * (each.gap - kept) - 0.6 * each.closing, -CRUISING))
        return wanted


class _Kind:
    """A kind of ego: makes the driver of a run; its settings are those of the model.

    Attributes:
        description: for people, one line.
        complete: the model fixes all settings: those that a scenario has for the AV under test do not apply to it.
    """

    complete = True

    def __init__(self, model: Callable[..., ReferenceModel]):
        self._model, self.description = model, (model.__doc__ or "").splitlines()[0]

    def __call__(self, rng: np.random.Generator, set_speed: float, *, recovery: float = 2.0, **settings: Any) -> ReferenceDriver:
        """Return the driver of one run; it draws nothing from `rng`.

        Raises:
            InputError: a setting is not a number >= 0.
        """
        for name, value in {**settings, "recovery": recovery}.items():
            number = isinstance(value, int | float) and not isinstance(value, bool) and value >= 0
            if not number and not (name == "wandering" and value is None):
                raise InputError(f"ego.{name} must be a number >= 0, but got {value!r}")
        return ReferenceDriver(self._model(**settings), set_speed, recovery)


CC_HUMAN, REG157, RSS, FSM = map(_Kind, (HumanDriver, MinimumRequirement, ResponsibilitySensitive, FuzzySafety))
