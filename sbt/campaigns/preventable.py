"""Which failures the reference drivers would have avoided: columns and words."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from sbt.campaigns.wording import plural
from sbt.store.records import Judgement

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["DRIVERS", "KNOWN_LIMITS", "count_avoided", "describe_judgements", "with_judgements"]

DRIVERS = ("cc_human", "reg157", "rss", "fsm")
"""The four reference drivers."""
KNOWN_LIMITS = (
    "Avoided by: the same inputs and seed with a reference driver in the place of ego meet the requirement (UN Regulation 157:"
    " cc_human the competent and careful human driver, reg157 the regulation's minimum; rss, fsm). The drivers keep their lane,"
    " see without error and only brake. They are models and differ from people: in 38 real near-crashes cc_human braked later"
    " and fsm earlier than the people did (arXiv 2406.09493)."
)


def describe_judgements(judgements: Iterable[Judgement]) -> str:
    """Return in words which drivers avoided a run; "" without judgements.

    >>> describe_judgements([Judgement(3, "rss", True), Judgement(3, "fsm", False, True, 0.0)])
    'by rss; not by fsm (collision)'
    """
    found = list(judgements)
    judged = [j for j in found if j.avoided is not None]
    if not judged:
        return "; ".join(dict.fromkeys(f"not applicable: {j.reason}" for j in found))
    parts = []
    if avoided := [j.driver for j in judged if j.avoided]:
        parts.append(f"by {', '.join(avoided)}")
    if not_avoided := [f"{j.driver} (collision)" if j.collision else j.driver for j in judged if not j.avoided]:
        parts.append(f"not by {', '.join(not_avoided)}")
    if undecided := [j.driver for j in found if j.avoided is None]:
        parts.append(f"not judged by {', '.join(undecided)}")
    return "; ".join(parts)


def count_avoided(modes: Sequence[Sequence[Judgement]]) -> list[str]:
    """Return in a sentence how many of the judged failure modes each driver avoids; none without judgements."""
    if not modes:
        return []
    drivers = dict.fromkeys(each.driver for mode in modes for each in mode)
    avoided = {name: sum(each.avoided is True for mode in modes for each in mode if each.driver == name) for name in drivers}
    unjudged = sum(all(each.avoided is None for each in mode) for mode in modes)
    rest = f"; to {unjudged} the models are not applicable" if unjudged else ""
    if unjudged == len(modes):
        return [f"The reference drivers' models are not applicable to {plural(unjudged, 'failure mode')}: nothing was judged."]
    judged = plural(len(modes), "judged failure mode")
    if not any(avoided.values()):
        return [f"Of {judged}, none of the reference drivers in the place of ego ({', '.join(avoided)}) avoids any{rest}."]
    counts = (f"{name} {count}" for name, count in avoided.items())
    return [f"Of {judged}, reference drivers in the place of ego avoid: {', '.join(counts)}{rest}."]


def with_judgements(frame: pd.DataFrame, judgements: Sequence[Judgement]) -> pd.DataFrame:
    """Return a frame of runs with a column `avoided.<driver>` for each driver, and `preventable` in words.

    Args:
        frame: a row a run, with the column `index`; without judgements it is returned as it is.
        judgements: of some of the runs; NA and "" for the others.
    """
    import pandas as pd

    if not judgements:
        return frame
    rows = {int(index): row for row, index in enumerate(frame["index"])}
    by_run: dict[int, list[Judgement]] = {}
    for each in judgements:
        by_run.setdefault(each.run, []).append(each)
    columns: dict[str, object] = {}
    for driver in dict.fromkeys(each.driver for each in judgements):
        values, missing = np.zeros(len(frame), dtype=bool), np.ones(len(frame), dtype=bool)
        for each in judgements:
            if each.driver == driver and each.avoided is not None and each.run in rows:
                values[rows[each.run]], missing[rows[each.run]] = each.avoided, False
        columns[f"avoided.{driver}"] = pd.arrays.BooleanArray(values, missing)
    words = [""] * len(frame)
    for run, some in by_run.items():
        if run in rows:
            words[rows[run]] = describe_judgements(some)
    return frame.assign(**columns, preventable=words)
