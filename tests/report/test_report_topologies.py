from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ssmpipe.contract import ShapeInfo
from ssmpipe.report.build import build_report
from ssmpipe.report.sections.grids import area_factors, grid_nodes
from ssmpipe.stages import model
from tests.stages.test_optimize_topologies import go, optimized
from tests.support.small_run import small_run


@pytest.mark.parametrize("kind", ["tube", "cone", "closed"])
def test_surfaces_that_close_have_a_report(kind):
    made, _ = optimized(kind, max_iterations=5)
    c = made["correspondence"]
    built, _ = go(model, correspondence=c, info={i: ShapeInfo(i) for i in c.ids})
    run = dataclasses.replace(
        small_run(c.ids),
        correspondence=c,
        model=built["model"],
        certificate=made["certificate"],
        history=made["history"],
    )
    page = build_report(**run.arguments())
    assert f'"topology": "{kind}"' in page or f'"topology":"{kind}"' in page
    for one in c.parameters:
        factors = area_factors(grid_nodes(one, c.grid, c.topology))
        assert factors.shape == (c.grid[0], c.grid[1] - 1)
        assert (factors > 0).all()
        assert factors.mean() == pytest.approx(np.ones(1), abs=1e-9)
