"""The campaigns, and the parts that a campaign of one's own is put together from."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sbt.campaigns.choices import Chosen, evenly
    from sbt.campaigns.parts import BatchStage, critical_share, held_out_runs, named_inputs
    from sbt.campaigns.records import BatchProposal
    from sbt.campaigns.settings import CampaignKind, PlainConclusion, Settings
    from sbt.loop.stages import Batch, Campaign, Facts, Log
    from sbt.seeds import stream
    from sbt.store.database import PlannedRun

_FROM = {
    "sbt.campaigns.choices": ("Chosen", "evenly"),
    "sbt.campaigns.parts": ("BatchStage", "critical_share", "held_out_runs", "named_inputs"),
    "sbt.campaigns.records": ("BatchProposal",),
    "sbt.campaigns.settings": ("CampaignKind", "PlainConclusion", "Settings"),
    "sbt.loop.stages": ("Batch", "Campaign", "Facts", "Log"),
    "sbt.seeds": ("stream",),
    "sbt.store.database": ("PlannedRun",),
}
"""Where the names are defined."""
_NAMES = {name: module for module, names in _FROM.items() for name in names}

__all__ = [
    "Batch", "BatchProposal", "BatchStage", "Campaign", "CampaignKind", "Chosen", "Facts", "Log", "PlainConclusion", "PlannedRun",
    "Settings", "critical_share", "evenly", "held_out_runs", "named_inputs", "stream",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import a part when it is asked for (PEP 562)."""
    if name not in _NAMES:
        raise AttributeError(f"module 'sbt.campaigns' has no attribute '{name}'; it has {', '.join(__all__)}")
    return getattr(import_module(_NAMES[name]), name)


def __dir__() -> list[str]:
    """Return the parts."""
    return sorted(__all__)
