"""The exceptions a user is meant to read: one kind, told apart by what is wrong."""

from __future__ import annotations


class UserError(Exception):
    """Something the user gave cannot work; the message says what was found, what was expected and what to do.

    The commands print the message alone, without a traceback, and exit with status 2.
    """


class CaptureError(UserError, ValueError):
    """A capture (file, array or geometry) is unusable."""


class MemoryBudgetError(UserError, MemoryError):
    """A computation needs more memory than the budget allows."""
