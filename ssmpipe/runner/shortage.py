"""Whether enough shapes are left for the group stages."""

from __future__ import annotations

from ssmpipe.runner.config import RunConfig


def shortage(config: RunConfig, n_left: int, n_all: int) -> str:
    """Return why the group stages cannot be run with the shapes that are left, and a remedy; empty when they can."""
    left, mend = f"{n_left} of {n_all} shapes are left", "mend the shapes that failed"
    if n_left < config.min_shapes:
        lower = ", or lower min_shapes" if n_left >= 2 else ""
        return f"{left}, at least {config.min_shapes} are needed (min_shapes); try: {mend}, add scans{lower}"
    if n_all - n_left > config.max_failed_fraction * n_all:
        share = f"more than {config.max_failed_fraction:g} failed (max_failed_fraction)"
        return f"{left}, {share}; try: {mend}, take them out of input.scans, or raise max_failed_fraction"
    return ""
