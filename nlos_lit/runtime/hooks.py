"""What Python tells by itself of errors that no code around them can catch: a word, or nothing.

Ctrl-C comes while libraries load, while Hydra composes and inside destructors; a full disk stops the threads
and log handlers of libraries, whose files are told of by whatever is written next.
"""

from __future__ import annotations

import functools
import logging
import signal
import sys
import threading
from types import TracebackType

from nlos_lit.runtime.command_line import REFUSED

AGAIN = 0.05  # s


@functools.cache
def take_hooks() -> None:
    """Take the places where Python tells of errors, for the rest of the process.

    An uncaught Ctrl-C is told in a word, one that Python would ignore comes again, and what the disk refuses
    to a library's own thread or log handler is left to the next write of ours to tell.

    Python cannot raise an exception out of a destructor or a weak reference's callback: it prints a traceback
    and goes on.
    """
    uncaught, unraisable, in_thread = sys.excepthook, sys.unraisablehook, threading.excepthook
    in_handler = logging.Handler.handleError

    def excepthook(kind: type[BaseException], error: BaseException, at: TracebackType | None) -> None:
        if issubclass(kind, KeyboardInterrupt):
            print("interrupted", file=sys.stderr)
        else:
            uncaught(kind, error, at)

    def unraisablehook(told: sys.UnraisableHookArgs, /) -> None:
        if issubclass(told.exc_type, KeyboardInterrupt):
            main = threading.main_thread().ident
            later = threading.Timer(AGAIN, signal.pthread_kill, (main, signal.SIGINT))
            later.daemon = True
            later.start()
        else:
            unraisable(told)

    def thread_hook(told: threading.ExceptHookArgs, /) -> None:
        if not _refused(told.exc_value):
            in_thread(told)

    def handle_error(handler: logging.Handler, record: logging.LogRecord) -> None:
        if not _refused(sys.exc_info()[1]):
            in_handler(handler, record)

    sys.excepthook, sys.unraisablehook, threading.excepthook = excepthook, unraisablehook, thread_hook
    logging.Handler.handleError = handle_error  # type: ignore[assignment, method-assign]


def _refused(error: BaseException | None) -> bool:
    return isinstance(error, OSError) and error.errno in REFUSED
