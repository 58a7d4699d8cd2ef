"""Ctrl-C wherever a command is: while libraries load, while Hydra composes, inside a destructor."""

from __future__ import annotations

import functools
import signal
import sys
import threading
from types import TracebackType

AGAIN = 0.05  # s


@functools.cache
def take_interrupts() -> None:
    """From now on an uncaught Ctrl-C is told in a word, and one that Python would ignore comes again.

    Python cannot raise an exception out of a destructor or a weak reference's callback: it prints a traceback
    and goes on.
    """
    excepthook, unraisablehook = sys.excepthook, sys.unraisablehook

    def uncaught(kind: type[BaseException], error: BaseException, at: TracebackType | None) -> None:
        if issubclass(kind, KeyboardInterrupt):
            print("interrupted", file=sys.stderr)
        else:
            excepthook(kind, error, at)

    def ignored(told: sys.UnraisableHookArgs, /) -> None:
        if issubclass(told.exc_type, KeyboardInterrupt):
            later = threading.Timer(
                AGAIN, signal.pthread_kill, (threading.main_thread().ident, signal.SIGINT)
            )
            later.daemon = True
            later.start()
        else:
            unraisablehook(told)

    sys.excepthook, sys.unraisablehook = uncaught, ignored
