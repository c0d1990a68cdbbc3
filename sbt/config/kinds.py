"""The campaign that a configuration names, while the configuration is being checked."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from sbt.campaigns.settings import CampaignKind
from sbt.plugins import Scope, load, names

__all__ = ["kind_of", "kinds", "looked_up_in"]

_SCOPE: ContextVar[Scope | None] = ContextVar("scope", default=None)


@contextmanager
def looked_up_in(scope: Scope) -> Iterator[None]:
    """Look campaigns up in this scope while a configuration is checked: its defaults depend on the campaign."""
    token = _SCOPE.set(scope)
    try:
        yield
    finally:
        _SCOPE.reset(token)


def kind_of(name: str) -> CampaignKind:
    """Return the kind of campaign with this name.

    Raises:
        InputError: there is none.
    """
    scope = _SCOPE.get() or Scope()
    return CampaignKind.of(scope.load("campaigns", name), name)


def kinds() -> dict[str, CampaignKind]:
    """Return the installed campaigns by name."""
    return {name: CampaignKind.of(load("campaigns", name), name) for name in names("campaigns")}
