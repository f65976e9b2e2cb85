from __future__ import annotations

from collections.abc import Callable

from tests.support.toys import GOOD


def test_types_are_strict(problems: Callable[..., list[str]]) -> None:
    (found,) = problems(GOOD.replace("factor: 3", "factor: 1.5 mm"))
    assert found == 'c.yaml:6: stages.0.grow.factor: should be a valid number (got "1.5 mm")'
    (found,) = problems(GOOD + "seed: 1.5\n")
    assert found.startswith("c.yaml:8: seed: should be a valid integer")
