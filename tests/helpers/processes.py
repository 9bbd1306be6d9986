"""Processes that others have begun, as `/proc` tells of them."""

import os
import time

import pytest

on_proc = pytest.mark.skipif(not os.path.isdir("/proc"), reason="looks for processes in /proc")


def children_of(*pids: int) -> list[int]:
    """Return the processes that any of these has begun."""
    found = []
    for entry in filter(str.isdigit, os.listdir("/proc")):
        try:
            with open(f"/proc/{entry}/stat", encoding="ascii", errors="replace") as file:
                parent = int(file.read().rpartition(")")[2].split()[1])
        except (OSError, ValueError, IndexError):
            # Processes come and go meanwhile.
            continue
        if parent in pids:
            found.append(int(entry))
    return found


def still_there(pids: list[int], patience_s: float) -> list[int]:
    """Return which of these live on after a while, at once if none does."""
    deadline = time.monotonic() + patience_s
    while (living := [pid for pid in pids if _lives(pid)]) and time.monotonic() < deadline:
        time.sleep(0.05)
    return living


def _lives(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat", encoding="ascii", errors="replace") as file:
            # A zombie has ended; whoever has begun it has not looked yet.
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
