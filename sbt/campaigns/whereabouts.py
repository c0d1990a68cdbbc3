"""Where a boundary's runs are critical, in the first words of its conclusion: regions, lines across it, or how much there is."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sbt.campaigns.reconciling import nowhere_likely
from sbt.campaigns.regions import only_words, regions_words
from sbt.campaigns.sides import all_critical, few_of_a_side, none_critical
from sbt.campaigns.wording import input_widths, requirement_words

if TYPE_CHECKING:
    from sbt.campaigns.boundary import BoundaryConclusion
    from sbt.loop.stages import Facts

__all__ = ["where_critical"]

_MATTERS = 0.01  # share of the direction across the boundary below which an input does not tell regions apart


def where_critical(found: BoundaryConclusion, facts: Facts) -> tuple[str, str]:
    """Return where runs are critical, and the same on lines across the boundary where that was told by regions; else ""."""
    of, here = (f" {word} {facts.scenario}" if facts.scenario else "" for word in ("of", "In"))
    here, condition = here.strip() or "Here", requirement_words(facts.requirement, facts.unit, facts.units)
    if none_critical(facts):
        return f"No run{of} was critical ({condition}), and the metamodel knows no place where one is likely", ""
    if all_critical(facts):
        known = "the metamodel knows no place where one is likely not to be"
        return f"Every run{of} was critical ({condition}), and {known}", ""
    if found.chance_place is not None:
        return found.chance_place.words(here, condition, facts.units, input_widths(facts.history)), ""
    few = few_of_a_side(facts, pairs=found.over_traffic is not None)
    where, lines = ("", "") if found.place is None else _where(found, facts, few)
    if not where:
        return nowhere_likely(found, of, condition, few), ""
    if found.place is not None and (few or found.place.vague):
        why = few or "edges are less certain than the critical part is wide"
        unsharp = f"Where runs{of} are critical ({condition}) is not known sharply yet: {why}"
        return f"{unsharp}. The metamodel's best guess is that a run is critical where {where}", lines
    return f"{here}, a run is critical ({condition}) where {where}", lines


def _where(found: BoundaryConclusion, facts: Facts, few: str | None) -> tuple[str, str]:
    """Return the place in words, and its lines where regions were told instead; "" for a place that is nowhere told."""
    place, widths = found.place, input_widths(facts.history)
    if place is None:
        return "", ""
    lines = place.words(facts.units, widths) if place.cuts else ""
    regions = () if few or place.vague or found.regions is None else found.regions  # roughness would be counted
    first, *others = place.inputs
    telling = [first, *(name for name in others if place.weights.get(name, 1.0) >= _MATTERS)]
    where = regions_words(regions, telling, facts.units, widths)
    if where:
        return where, lines
    only = only_words(regions, facts.units)
    if not only:
        return lines, ""
    return f"{lines}, and only with {only}" if lines else f"it has {only} (by the metamodel)", ""
