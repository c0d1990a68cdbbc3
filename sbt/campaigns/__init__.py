"""The campaigns, and the parts that a campaign of one's own is put together from."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_FROM = {
    "BatchProposal": "sbt.campaigns.records", "BatchStage": "sbt.campaigns.parts", "CampaignKind": "sbt.campaigns.settings",
    "Chosen": "sbt.campaigns.choices", "PlainConclusion": "sbt.campaigns.settings", "Settings": "sbt.campaigns.settings",
    "critical_share": "sbt.campaigns.parts", "evenly": "sbt.campaigns.choices", "held_out_runs": "sbt.campaigns.parts",
    "named_inputs": "sbt.campaigns.parts",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import a part when it is asked for (PEP 562)."""
    if name not in _FROM:
        raise AttributeError(f"module 'sbt.campaigns' has no attribute '{name}'; it has {', '.join(_FROM)}")
    return getattr(import_module(_FROM[name]), name)
