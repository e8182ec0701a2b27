"""One rollout of a configuration at a time."""

from __future__ import annotations

import contextlib
import fcntl
import os


class Busy(Exception):
    """Another rollout of the same file is at work."""


@contextlib.contextmanager
def alone(config):
    """Holds the lock of that configuration: a file of its own, which stays, because the configuration itself is replaced."""
    lock = os.open(f"{config}.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise Busy(f"another rollout is at work on {config}; wait for its end") from error
        yield
    finally:
        os.close(lock)
