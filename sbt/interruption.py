"""Ctrl-C and other signals that end a campaign, told apart from a KeyboardInterrupt that a user's code raises.

Python turns Ctrl-C into a `KeyboardInterrupt`, which any code may raise as well. Only a signal handler knows
that there was a signal: the one installed here remembers it. A run may then raise what it likes; it is an
interruption only if a signal has arrived.

Python drops an exception that is raised in a finaliser or in the callback of a weak reference (the lock of an import has
one). An interruption that ended there is raised again a moment later.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

__all__ = ["check", "handled", "is_interruption", "requested"]

Notify = Callable[[int], bool]
"""Is called with every signal; returns whether it interrupts."""
_received: list[int] = []
_SOON = 0.02
"""Seconds after which an interruption that was dropped is raised again."""


class _Handler:
    """Remembers a signal, does what was done before, and interrupts."""

    def __init__(self, before: Any, notify: Notify | None):
        self.before, self._notify = before, notify
        self.active, self._repeated = True, False

    def __call__(self, number: int, frame: Any) -> None:
        if self._repeated:
            self._repeated = False
        elif self.active:  # other code may have kept the handler for later
            _received.append(number)
            if self._notify is not None and not self._notify(number):
                return
        if number == signal.SIGINT and callable(self.before):
            self.before(number, frame)  # Python's own raises KeyboardInterrupt
        raise KeyboardInterrupt

    def repeat(self, number: int) -> None:
        """Raise again what has been raised and was dropped."""
        installed: Any = signal.getsignal(number)
        if self.active and installed is self:
            self._repeated = True
            signal.pthread_kill(threading.main_thread().ident or 0, number)


class _Dropped:
    """What Python calls with an exception that it cannot raise: an interruption among them is raised again."""

    def __init__(self, before: Callable[[Any], Any]):
        self.before = before

    def __call__(self, dropped: Any) -> None:
        handler = signal.getsignal(_received[-1]) if _received else None
        if not isinstance(dropped.exc_value, KeyboardInterrupt) or not isinstance(handler, _Handler):
            self.before(dropped)
            return
        again = threading.Timer(_SOON, handler.repeat, (_received[-1],))  # not from here, where it would be dropped as well
        again.daemon = True
        again.start()


@contextmanager
def handled(*numbers: int, notify: Notify | None = None) -> Iterator[None]:
    """Raise KeyboardInterrupt in the main thread when a signal arrives, and remember it.

    Nothing is installed in other threads, for signals that are ignored (nohup, a shell's background), and for
    those that are handled by an outer `handled` already.

    Args:
        numbers: of the signals; default: SIGINT.
        notify: called first, each time; where it returns False nothing is raised.
    """
    installed: dict[int, Any] = {}
    outermost = False
    if threading.current_thread() is threading.main_thread():
        outermost = not isinstance(signal.getsignal(signal.SIGINT), _Handler)
        for number in numbers or (signal.SIGINT,):
            before = signal.getsignal(number)
            if before not in (None, signal.SIG_IGN) and not isinstance(before, _Handler):
                installed[number] = _Handler(before, notify)
        if installed and outermost:
            _received.clear()
    dropped = _Dropped(sys.unraisablehook)
    try:
        if installed and outermost:
            sys.unraisablehook = dropped
        for number, own in installed.items():
            signal.signal(number, own)
        yield
    finally:
        if sys.unraisablehook is dropped:
            sys.unraisablehook = dropped.before
        for number, own in installed.items():
            own.active = False
            now: Any = signal.getsignal(number)
            if now is own:
                signal.signal(number, own.before)
        if installed and outermost:
            _received.clear()


def requested() -> bool:
    """Return whether a signal has arrived since the handlers were installed."""
    return bool(_received)


def check() -> None:
    """Raise the KeyboardInterrupt of a signal again, which a user's code may have caught."""
    if _received:
        raise KeyboardInterrupt


def is_interruption(error: BaseException) -> bool:
    """Return whether an exception comes from a signal, and not from the code that it passed through.

    A KeyboardInterrupt counts as one also where no handler of ours is installed and Python's (or another) may have raised it.
    """
    if _received:
        return True
    if not isinstance(error, KeyboardInterrupt) or threading.current_thread() is not threading.main_thread():
        return False
    handler = signal.getsignal(signal.SIGINT)
    return callable(handler) and not isinstance(handler, _Handler)
