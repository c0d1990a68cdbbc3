"""The first three sentences of every conclusion: the answer, what it does not tell, and what to do next.

The first can be pasted: it names the scenario, the requirement, the interval, and what it rests on.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sbt.campaigns.combinations import none_left
from sbt.campaigns.counting import RANDOM, random_draws
from sbt.campaigns.gate import CONDITION
from sbt.campaigns.linking import modes_counted
from sbt.campaigns.lost import (
    decides_bound,
    equally_near,
    lost_runs,
    narrower,
    nearest_words,
    none_gave_a_metric,
    nothing_known,
    repetitions,
    runs_to_halve,
    why_they_fail,
)  # fmt: skip
from sbt.campaigns.modes import most_often, single
from sbt.campaigns.precision import NO_BETTER, PRECISE, always_agree, as_many_draws, more_runs, rounded, too_wide
from sbt.campaigns.reconciling import denial, ends, reconciled
from sbt.campaigns.records import CONFIRM
from sbt.campaigns.sides import all_critical, met, safe_runs
from sbt.campaigns.whereabouts import where_critical
from sbt.campaigns.wording import digits_beside, estimating, measured, number, percent, plural, requirement_words, widening
from sbt.estimators.binomial import interval, unmet_draws
from sbt.loop.stages import Facts

if TYPE_CHECKING:
    from sbt.campaigns.boundary import BoundaryConclusion
    from sbt.campaigns.estimation import EstimationConclusion
    from sbt.campaigns.failures import FalsificationConclusion
    from sbt.campaigns.modes import FailureMode
    from sbt.campaigns.parts import CriticalShare

__all__ = ["tell_boundary", "tell_estimation", "tell_failures", "tell_share"]

_TOO_FAR = 1e6  # a number of runs that nobody is advised to make
_SMALL_SHARE = 0.01  # bound of the critical share that a coverage of 300 runs without a critical one gives


def tell_share(share: CriticalShare, facts: Facts) -> list[str]:
    """Return the three sentences of a coverage, or of the held-out runs where there is no metamodel."""
    if share.critical_fraction is None:
        return nothing_known(facts)
    where, runs, lost = _of(facts), plural(share.counted, "run"), share.lost or 0
    runs += " taken to be" if facts.recorded else ""
    space = f"what gives a metric in the parameter space{where}" if lost else f"the parameter space{where}"
    said = f"{percent(share.critical_fraction)} of {space} is critical ({_condition(facts)}; {ends(share)})"
    if share.critical_fraction == 0.0:
        most = f"at most {percent(share.high)} of the parameter space is"
        said = f"No run{where} was critical ({_condition(facts)}): {most} ({ends(share)})"
        further = "campaign: falsification searches for the rare critical run; as many even runs again only halve the bound"
    elif share.critical_fraction == 1.0:
        further = widening(facts.recorded)
    elif (more := runs_to_halve(lost, share.counted, share.low, share.high)) > _TOO_FAR:
        further = f"failed runs decide the width of this interval, and more runs never halve it: {why_they_fail()}"
    elif (warm_ups := _deciding_warm_ups(share, facts)) is not None:
        further = _more_warm_ups(warm_ups)
    else:
        further = (
            f"campaign: boundary says where critical runs lie, {estimating(facts.recorded)} how probable they are; about"
            f" {rounded(more):,} more runs would halve this interval"
        )
    return [
        f"{said}, by {runs} spread evenly over it{f'; {lost_runs(lost, share.counted)}' if lost else ''}.",
        "This does not tell how probable critical runs are in traffic, since every part of the ranges counts the same, nor where"
        " they lie.",
        f"Next: {further}.",
    ]


def _deciding_warm_ups(share: CriticalShare, facts: Facts) -> int | None:
    """Return the number of warm-ups where the spread between them, more than that of runs, makes a share's interval wide."""
    warm_up, n = facts.history.columns["warm_up"], share.counted
    if share.critical_fraction is None or n == 0 or not (warm_up >= 0).any():
        return None
    low, high = interval(round(share.critical_fraction * n), n, share.confidence)
    return len(np.unique(warm_up)) if share.high - share.low > NO_BETTER * float(high - low) else None


def _more_warm_ups(number: int) -> str:
    return (
        f"more warm-ups than {number} (warm_up.seeds), in a campaign of their own: how traffic differs between them decides the"
        " width of the interval, and more runs hardly narrow it"
    )


def tell_boundary(found: BoundaryConclusion, measured_share: CriticalShare, facts: Facts) -> list[str]:
    """Return the three sentences of a boundary, and how its figures of the critical share fit together."""
    if found.critical_fraction is None:
        return tell_share(measured_share, facts)
    scores, pairs = found.validation, found.over_traffic
    learned = len(facts.history.training) if pairs is None else pairs.runs
    tested = scores is not None and scores.n > 0 and scores.error_rate is not None
    if tested and scores is not None and scores.error_rate is not None:
        wrong = round(scores.error_rate * scores.n)
        low, high = (percent(float(end)) for end in interval(wrong, scores.n))
        sure = (
            f"of {plural(scores.n, 'run')} that it had not seen, {wrong:,} lay on the wrong side"
            f" ({percent(scores.error_rate)}, 95 % interval {low} to {high})"
        )
    else:
        sure = "no held-out run tested it"
    lead, lines = where_critical(found, facts)
    rests = f"the metamodel learned that from {plural(learned, 'run')}{f' and {found.earlier} earlier' if found.earlier else ''}"
    missing = "an uncritical" if all_critical(facts) else "a critical"
    said = [
        f"{lead}; {rests}, and {sure}.{'' if facts.uneven else denial(found, measured_share, recorded=facts.recorded)}",
        f"This does not tell how probable critical runs are in traffic, since every part of the ranges counts the same; {missing}"
        f" region smaller than the gaps between {plural(learned, 'run')} may be missing from it.",
        f"Next: {_every_combination(facts)}{_after_boundary(found, facts, tested=tested)}.",
    ]
    if lines:
        said.append(f"On lines across the boundary, a run is critical where {lines}.")
    return [*said, *reconciled(found, measured_share, learned, recorded=facts.recorded, uneven=facts.uneven)]


def _after_boundary(found: BoundaryConclusion, facts: Facts, *, tested: bool) -> str:
    if all_critical(facts):
        return widening(facts.recorded)
    if not tested and facts.recorded:
        return "test it: a smaller budget leaves rows that score the metamodel"
    if not tested:
        return "test it: validation.reference: 300 scores the metamodel on 300 more runs drawn at random"
    scores, unsure = found.validation, found.ambiguous_volume or 0.0
    if scores is not None and scores.n_critical < 10:
        few = f"held-out runs with so few critical ones among them ({scores.n_critical} of {scores.n})"
        if 2 * scores.n_critical > scores.n:
            few = f"so few held-out runs ({scores.n}, {scores.n_critical} of them critical)"
        more = "" if facts.recorded else ", or validation.reference: 300,"
        return f"a larger budget{more} since {few} cannot tell whether a critical region is missing"
    if found.place is None:
        return "campaign: falsification searches for the rare critical run"
    return (
        f"twice the budget puts as many runs again where the metamodel is unsure, {percent(unsure)} of the space now;"
        f" {estimating(facts.recorded)} says how probable the critical side is"
    )


def tell_failures(found: FalsificationConclusion, random: CriticalShare, facts: Facts) -> list[str]:
    """Return the three sentences of a falsification."""
    if found.first_critical_run is None:
        return _nothing_found(found, facts)
    modes = found.failure_modes
    worst = f"; {_worst(modes[0], facts)}" if modes else ""
    often = most_often(modes)
    if often is not None and often is not modes[0]:
        again = repetitions(*often.came_back, often.confirmations_lost or 0)
        worst += f"; run {often.representative} came back more often, in {again}"
    searched = int((facts.history.stage != CONFIRM).sum())
    many = modes_counted(len(modes), single(modes, facts.history), found.links)
    between = ", with critical runs that were met on the way between them" if len(modes) > found.critical_runs else ""
    inputs = found.critical_inputs
    at = "" if inputs is None else ", all at one input" if inputs == 1 else f", at {inputs:,} different inputs"
    said = (
        f"The requirement{_of(facts)} is falsified: {found.critical_runs:,} of {plural(searched, 'run')} of the search"
        f" {'was' if found.critical_runs == 1 else 'were'} critical ({_condition(facts)}), the first after"
        f" {plural(found.runs_to_first or 0, 'run')}{at}, in {many}{between}{worst}."
    )
    exhausted, silent = none_left(facts), "This does not tell how probable a failure is, since results chose the runs"
    silent += "" if exhausted else ", nor that there is no other mode"
    if random.critical_fraction is not None:
        few = "too few to meet what is rare" if random.critical_fraction == 0.0 else "all that may be read as a share"
        told, gave, space = random, "among them", "the parameter space"
        if random.lost:
            told, gave, space = random.given_a_metric, "that gave a metric among those", "what gives one"
        silent += (
            f"; the {plural(told.counted, 'run')} {gave} drawn at random say{'s' * (told.counted == 1)}"
            f" {percent(told.critical_fraction or 0.0)} of {space} ({ends(told)}), {few}"
        )
    look = "" if often is None else f"look at run {often.representative} (replay) and keep it as a test (pin{often.never}); "
    rest = "every combination of the inputs was run" if exhausted else "a larger budget looks for more modes"
    more = f"{look}{estimating(facts.recorded)} says how probable failures are, {rest}"
    return [said, f"{silent}.", f"Next: {more}."]


def _met(run: int, value: float | None, facts: Facts) -> str:
    """Return the metric of a run in words; a value of None is infinite, and the run says which."""
    if value is None:
        value = float(facts.requirement.told(facts.history)[facts.history.index == run][0])
    return measured(facts.requirement.told_as, value, facts.unit, digits_beside(value, facts.requirement))


def _worst(mode: FailureMode, facts: Facts) -> str:
    """Return the deepest failure and how often it came back, in words."""
    history, margins = facts.history, facts.requirement.margins(facts.history)
    one = "one of the worst" if equally_near(facts) > 1 else "the worst"
    said = f"{one}, run {mode.representative} ({_met(mode.representative, mode.metric, facts)})"
    if np.isfinite(margins).any():
        deepest = int(history.index[int(np.nanargmin(margins))])
        own = history.index == mode.representative
        if own.any() and np.nanmin(margins) < margins[own][0]:  # of a noisy simulator: the likeliest is not the deepest
            said = said.replace(f"{one}, ", "", 1) + f", by the search the likeliest to fail again (run {deepest} is the deepest)"
    n, lost = mode.confirmation_runs, mode.confirmations_lost or 0
    if n == 0:
        return f"{said}, was not repeated"
    again, gave = mode.came_back
    if not gave:
        return f"{said}, gave no metric in any of {plural(n, 'repetition')} with fresh seeds"
    low, high = percent(float(interval(again, n)[0])), percent(float(interval(again + lost, n)[1]))
    return f"{said}, was critical again in {repetitions(again, gave, lost, ' with fresh seeds')} (95 % interval {low} to {high})"


def _nothing_found(found: FalsificationConclusion, facts: Facts) -> list[str]:
    bound = found.bound
    if none_left(facts):
        said = f"None of all {facts.combinations:,} combinations of the inputs{_of(facts)} is critical ({_condition(facts)})"
        return [f"{said}; all were run.", "This does not tell of other values.", "Next: wider ranges, if other values matter."]
    searched = plural(len(facts.history), "run")
    said = f"The requirement{_of(facts)} was not falsified: none of {searched} was critical ({_condition(facts)})"
    silent = "This does not tell that there is no failure: guided runs bound nothing"
    silent += ", nor do rows that are not spread evenly over the parameter space" if facts.uneven else ""
    further = "a larger budget"
    if bound is not None and bound.space_filling_runs:
        share = bound.box_fraction_failed_as_critical
        said += (
            f"; with {percent(bound.confidence)} confidence at most {percent(share)} of the parameter space is, by the"
            f" {plural(bound.space_filling_runs, 'space-filling run')} alone"
        )
        decided = decides_bound(bound.failed_runs / bound.space_filling_runs, share)
        if decided is not None:
            further = decided
        elif share > _SMALL_SHARE:
            none = "if none is critical or fails" if bound.failed_runs else "if none is critical"
            further += f", or campaign: coverage with 300 runs, which bounds that by {percent(_SMALL_SHARE)} {none}"
    closest = found.closest
    if closest is not None:
        further += f"; {nearest_words(closest.run, _met(closest.run, closest.metric, facts), facts)}"
    silent += ", and a failure in a small part of the space may be there."
    return [f"{said}.", silent, f"Next: {_every_combination(facts)}{further}."]


def tell_estimation(found: EstimationConclusion, facts: Facts) -> list[str]:
    """Return the three sentences of an estimation."""
    confidence, n = percent(found.confidence), len(facts.history)
    verdict = "" if found.gate is None else f"Gate: {found.gate.verdict}; {found.gate.statement}. "
    if none_gave_a_metric(facts):
        first, *rest = nothing_known(facts)
        return [f"{verdict}{first}", *rest]
    rests = "" if n == 0 else f", from {plural(n, 'run')}"
    every = found.combinations is not None and found.undetected_mass_bound == 0.0
    critical = f"{found.hits:,} of them {'was' if found.hits == 1 else 'were'} critical"
    if found.counted and (every or found.drawn_combinations):
        rests += f", of which {found.counted:,} count, {_combinations(found)}, and {critical}"
    elif found.counted:
        rests += f", of which {plural(found.counted, 'random draw')} count{'s' if found.counted == 1 else ''} and {critical}"
    subject = f"a critical run{_of(facts)} ({_condition(facts)}) under the inputs' distribution"
    if found.exact_bound is not None:
        most = f"with {confidence} confidence the probability of {subject} is at most {number(found.exact_bound, 3)}"
        known = met(facts)
        said = f"{known}, but none by the draws that count: {most}" if known else f"No critical run was drawn: {most}"
        exact = facts.history.ok.all() and 0.0 < found.exact_bound < 1.0
        draws = plural(unmet_draws(found.exact_bound, found.confidence), "draw") if exact else "draws"
        rests = f", by {draws} from the inputs' distribution among {plural(n, 'run')}"
        silent = "This does not tell that there is none: a smaller probability cannot be told from zero by so many draws"
        if known:
            silent = "This does not tell how probable they are: the critical runs were chosen by results, or only taught"
    elif found.probability is None:
        said = f"The probability of {subject} is not known yet: no draw counts"
        how = "only fill the space" if (facts.history.stage == "initial").all() else "were chosen by results"
        how = "only taught, or were chosen by results" if (facts.history.stage == RANDOM).any() else how
        silent = f"The critical runs so far {how}, so their share is no estimate"
    else:
        ends = f"{confidence} interval {number(found.low, 3)} to {number(found.high, 3)}"
        if every and always_agree(found) and found.failed_as_critical in (None, found.probability):
            ends += ", exact if the simulator is deterministic"
        said = f"The probability of {subject} is {number(found.probability, 3)} ({ends})"
        if found.counted and not found.hits and found.combinations is None:
            guess = f"no draw that counts was critical, and {number(found.probability, 3)} is the metamodel's own guess"
            said = f"The probability of {subject} is at most {number(found.high, 3)} ({confidence} interval from 0): {guess}"
        if found.probability >= 1.0 and safe_runs(facts):
            said = f"The probability of {subject} is at least {number(found.low, 3)} ({confidence} interval to 1)"
        silent = _not_told(found, facts, every)
    every_one = "" if found.drawn_combinations else _every_combination(facts)
    better = as_many_draws(found, len(facts.history))
    return [f"{verdict}{said}{rests}.", f"{silent}.", f"Next: {every_one}{_after_estimation(found, facts)}{better}."]


def _combinations(found: EstimationConclusion) -> str:
    """Return how many combinations of the inputs were run, each for itself or by random draws."""
    n, drawn = found.combinations or 0, found.drawn_combinations or 0
    if not drawn:
        return f"all {n:,} combinations of the inputs"
    return f"{n - drawn:,} of all {n:,} combinations of the inputs and, as the simulator is noisy, random draws for the others"


def _not_told(found: EstimationConclusion, facts: Facts, every: bool) -> str:
    """Return what an estimate does not tell; `every` combination of the inputs was run."""
    confidence, p = percent(found.confidence), found.probability or 0.0
    missed = min(found.undetected_mass_bound, 1.0 - p)
    silent = (
        "This does not tell of critical regions that no run has met, nor of failures that few seeds show wherever: with"
        f" {confidence} confidence they hold at most {number(missed, 3)} more, which bounds the unseen and is no second"
        " estimate"
    )
    if found.counted and found.counted == random_draws(facts.history):
        silent = "This trusts no search: the interval is that of random draws, and covers what none of them has met"
    if missed <= 0.0:
        safe, most = safe_runs(facts), f"{number(1.0 - found.low, 3)} may not be"
        silent = f"This does not tell that every run is critical: {most}, which no run met"
        if safe:
            how = "was not critical, but its weight is" if safe == 1 else "were not critical, but their weights are"
            silent = f"This does not tell how probable the others are: {most}. {plural(safe, 'run')} {how} too uneven to tell"
    if every:
        silent = "This is a sum over all combinations: none is unseen"
        if found.drawn_combinations:
            silent = "This is a sum over all combinations: what its random draws have not met is in its interval"
            return silent + ", as is what seeds may decide"
        silent += ", and what seeds may decide is in its interval"
        silent += ", though no repeat came out otherwise" if always_agree(found) else ""
    elif found.low == 0.0 and found.hits:
        traffic, why = found.warmed_traffic, "of unequal weight"
        why = "of so few warm-ups" if traffic is not None and traffic.decides(found.cov, p) else why
        silent += (
            f". It does not tell that the probability may be 0 either, though the interval begins there: {found.hits:,}"
            f" critical draw{'s' if found.hits > 1 else ''} {why} cannot exclude that it is far smaller"
        )
    elif missed > found.high:
        silent += " (the larger figure, since only draws from the inputs' distribution rule a region out, and there were few)"
    return silent


def _after_estimation(found: EstimationConclusion, facts: Facts) -> str:
    """Return how many more runs, and which, would tell more."""
    n = len(facts.history)
    worst = found.failed_as_critical
    if found.exact_bound is not None:
        lost = 0.0 if n == 0 else 1.0 - float(facts.history.ok.mean())
        kept = decides_bound(lost if worst is None else worst, found.exact_bound)
        if kept is not None:
            return kept
        if met(facts):
            return f"a larger budget than {n:,} runs, so that draws that count meet what has been met; look at the critical runs"
        return "campaign: falsification searches for the first critical run; ten times as many runs lower the bound tenfold"
    if found.probability is None:
        return f"a larger budget than {n:,} runs, so that after searching and learning some draws count"
    traffic = found.warmed_traffic
    by_traffic = traffic is not None and traffic.decides(found.cov, found.probability)
    there = int(facts.history.columns["warm_up"].max(initial=-1)) + 1  # those that no counted draw began with among them
    gate = None if found.gate is None or found.gate.verdict != "undecided" else found.gate.probability
    if worst is not None and worst - found.probability > 2.0 * PRECISE * found.probability and not (gate and gate > worst):
        more = f"more {'warm-ups (warm_up.seeds), hardly more runs,' if by_traffic else 'runs'}"
        return narrower(found.probability, worst, found.high, more)
    if found.combinations is not None and found.probability == 0.0:
        return "ten times as many runs bring the upper end of the interval to a tenth"
    if all_critical(facts):
        return widening(facts.recorded)
    if gate is not None:
        ends = f", with stop: {{cov: null}} as the campaign ends at {percent(PRECISE)} of the estimate otherwise"
        ends = ends if found.cov is not None and found.cov <= PRECISE else ""
        return f"a larger budget than {n:,} runs{ends}: it narrows the interval until it lies on one side of the gate"
    wide = too_wide(found)
    if wide > 1.0 and traffic is not None and by_traffic:
        return _more_warm_ups(max(traffic.warm_ups, there))
    if wide > 1.0 and (found.counted or n):
        return more_runs(found, n)
    return _where_narrow(found)


def _where_narrow(found: EstimationConclusion) -> str:
    """Return what would tell more than an interval that is narrow enough: what no run has met."""
    if found.gate is not None and found.gate.statement.startswith(CONDITION):
        draws = 3.0 / max(found.gate.probability - found.gate.upper, 1e-300)
        if draws < _TOO_FAR:
            return f"a larger budget: about {rounded(draws):,} random draws in all make the pass of the gate unconditional"
    unseen = 3.0 / max(found.probability or 0.0, 1e-300)
    if found.undetected_mass_bound > (found.probability or 0.0) and unseen < _TOO_FAR:
        return (
            f"it is narrow enough; to bound the unseen by the estimate itself, draw {rounded(unseen):,} runs from the"
            " inputs' distribution (acquisition: {kind: monte_carlo})"
        )
    return f"it is narrow enough{'; look at the critical runs in the report' if found.hits else ''}"


def _every_combination(facts: Facts) -> str:
    """Return the advice to run every combination of whole numbers and choices, where they are few and were not all run."""
    n = facts.combinations
    if n is None or len(facts.history) >= n:
        return ""
    return f"budget: {n:,} runs all {n:,} combinations of the inputs, after which none is unseen; or "


def _condition(facts: Facts) -> str:
    return requirement_words(facts.requirement, facts.unit, facts.units)


def _of(facts: Facts, word: str = "of") -> str:
    return f" {word} {facts.scenario}" if facts.scenario else ""
