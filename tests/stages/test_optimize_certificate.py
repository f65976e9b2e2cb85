from __future__ import annotations

import logging

import numpy as np

from ssmpipe.contract import Context
from ssmpipe.stages._optimize_certificate import warn_of_poles


def test_a_fold_at_a_pole_has_another_remedy_than_an_edge():
    def pole(status, deviation):
        return {"poles": [{"v": 0, "deviation_deg": deviation, "winding": 0.6, "status": status}]}

    ctx = Context("cohort", np.random.default_rng(0), logging.getLogger("test"))
    shapes = {"fine": pole("proved", 0.0), "edge": pole("refuted", 2.0), "fold": pole("refuted", 1e-13), "disk": {}}
    warn_of_poles(shapes, ctx)
    edge, fold = ctx.warnings
    assert "of edge is" in edge
    assert "fit.seam: smooth" in edge
    assert "of fold is" in fold
    assert "fit.n_control" in fold
    assert "seam" not in fold
