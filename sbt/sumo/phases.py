"""Where the CPU time of a run goes: loading, warming up until the ego departs, and the recorded run."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

__all__ = ["PHASES", "Stopwatch"]

PHASES = ("load", "warm-up", "run")
"""Reading the files; simulating until the ego departs; from then on."""


@dataclass
class Stopwatch:
    """CPU seconds of this process by phase; begins with the first one.

    Attributes:
        phase: the present one.
        seconds: spent in each so far.
    """

    phase: str = PHASES[0]
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PHASES, 0.0))
    _since: float = field(default_factory=lambda: time.process_time())  # looked up when asked, so that tests may set the clock

    def enter(self, phase: str) -> None:
        """End the present phase and begin another, or go on with the same."""
        now = time.process_time()
        self.seconds[self.phase] += now - self._since
        self.phase, self._since = phase, now
