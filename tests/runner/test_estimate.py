"""The cost that ``check`` announces; its constants come from ``benchmarks/group_cost.py``."""

from __future__ import annotations

from ssmpipe.runner.estimate import MEMORY_FACTOR, TIME_FACTOR, estimate


def test_cost_grows_with_everything_that_costs() -> None:
    base = estimate(20, (51, 51), (8, 8))
    for more in (estimate(40, (51, 51), (8, 8)), estimate(20, (71, 71), (8, 8)), estimate(20, (51, 51), (14, 14))):
        assert more.seconds > base.seconds
        assert more.memory_mb >= base.memory_mb
    assert estimate(10_000, (51, 51), (8, 8)).seconds / estimate(1000, (51, 51), (8, 8)).seconds > 100
    assert estimate(20, (301,), (20,)).seconds < base.seconds, "curves cost less"


def test_the_line_says_what_it_follows_from() -> None:
    text = estimate(34, (51, 51), (8, 8)).text
    assert text.startswith("group stages, 34 shapes x 2601 landmarks x 64 coefficients: about ")
    assert "expected between" in text
    assert MEMORY_FACTOR > 1
    assert TIME_FACTOR > 1
