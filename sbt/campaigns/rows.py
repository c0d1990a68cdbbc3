"""What a coverage of recorded rows that are not spread evenly tells: a share of the rows, and none of the parameter space."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sbt.campaigns.lost import nothing_known
from sbt.campaigns.reconciling import ends
from sbt.campaigns.wording import estimating, percent, requirement_words
from sbt.loop.stages import Facts

if TYPE_CHECKING:
    from sbt.campaigns.parts import CriticalShare

__all__ = ["tell_rows"]


def tell_rows(share: CriticalShare, rows: int, facts: Facts) -> list[str]:
    """Return the three sentences of a coverage of so many rows; its runs are drawn from them at random."""
    if share.critical_fraction is None:
        return nothing_known(facts)
    condition = requirement_words(facts.requirement, facts.unit, facts.units)
    of, whole = f" of {facts.scenario}" if facts.scenario else "", share.counted >= rows
    found = condition if whole else f"{condition}; {ends(share)}"
    taken = f"all {rows:,} were taken" if whole else f"by {share.counted:,} of them, taken at random"
    said = f"{percent(share.critical_fraction)} of the {rows:,} rows{of} are critical ({found}), {taken}."
    further = "campaign: boundary says where critical runs lie"
    if share.critical_fraction == 0.0:
        further = "campaign: falsification searches the other rows for a critical one"
        further = "the simulator that the rows are of, with campaign: falsification" if whole else further
    return [
        said,
        "This does not tell what share of the parameter space is critical, since its rows are not spread evenly over it"
        f" ({facts.uneven}), nor how probable critical runs are in traffic.",
        f"Next: {further}; {estimating(facts.recorded)} says how probable they are.",
    ]
