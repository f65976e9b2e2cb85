from __future__ import annotations

from collections.abc import Callable

from tests.support.toys import GOOD


def test_union_branches_are_one_problem(problems: Callable[..., list[str]]) -> None:
    (found,) = problems(GOOD.replace("scans: scans", "scans: {a: b}"))
    assert found == 'c.yaml:3: input.scans: should be a valid string or should be a valid array (got {"a": "b"})'
