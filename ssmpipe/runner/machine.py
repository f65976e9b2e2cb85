"""The machine that a run is made on, and how many children it is given."""

from __future__ import annotations

import os
import platform
from typing import Any

MAX_JOBS = 8


def default_jobs() -> int:
    """Return the number of processors that may be used, at most 8."""
    try:
        available = len(os.sched_getaffinity(0))
    except AttributeError:
        available = os.cpu_count() or 1
    return max(1, min(available, MAX_JOBS))


def machine() -> dict[str, Any]:
    """Return what the run was made on."""
    return {
        "system": platform.platform(),
        "processor": platform.machine(),
        "n_cpu": os.cpu_count(),
        "host": platform.node(),
    }
