"""The model that scans are projected into, and what is known of it before any scan is read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.choices import boundary_of, start_of
from ssmpipe.core.correspondence.options import EngineOptions
from ssmpipe.core.model.remainder import LeaveOneOut, Remainder, fit_remainder, leave_one_out
from ssmpipe.core.model.shape_model import ShapeModel
from ssmpipe.runner.chain import optimize_options
from ssmpipe.use.model import Model


@dataclass(frozen=True, eq=False)
class Target:
    """The model, and what is known of it before any scan is read; sent to the child processes.

    Parameters
    ----------
    model : ShapeModel
    options : EngineOptions
        Of the optimization that made it.
    others : LeaveOneOut
        Every training shape in the model of the others.
    remainder : Remainder
    name : str
        Of the file of the model.
    unit : str
        Of its lengths, in words.
    """

    model: ShapeModel
    options: EngineOptions
    others: LeaveOneOut
    remainder: Remainder
    name: str = "model.npz"
    unit: str = "mm"

    @classmethod
    def of(cls, model: Model, content: Mapping[str, Any]) -> Target:
        """Return what follows from a model and its chain."""
        shapes = model.shape_model
        found = leave_one_out(shapes.training_points)
        remainder = fit_remainder(found.residuals, shapes.mean)
        unit = "file units" if content.get("units") == "none" else "mm"
        return cls(shapes, engine_options(shapes, content), found, remainder, model.path.name, unit)

    @property
    def residuals(self) -> Floats:
        """Root mean square distance of every training shape from the model of the others, (n_S,) [mm]."""
        return np.asarray(np.sqrt((self.others.residuals**2).sum(axis=2).mean(axis=1)))


def engine_options(model: ShapeModel, content: Mapping[str, Any]) -> EngineOptions:
    """Return the options of the optimization with boundary and threshold resolved."""
    given = optimize_options(content)
    kept: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in given.items()
        if name in EngineOptions.__dataclass_fields__
        and name not in ("reference", "lambda_cut", "boundary", "start", "landmark_blocks", "normals")
    }
    start = start_of(
        given.get("start", "identity"),
        topology=model.topology,
        dimension=model.mean.shape[1],
        normalize=str(kept.get("normalize")),
        guided=bool(given.get("guides")),
        reference=given.get("reference", ""),
        rims=given.get("rims", "kept"),
    )
    boundary = boundary_of(given.get("boundary", "auto"), model.topology)
    return EngineOptions(**kept, boundary=boundary, lambda_cut=model.lambda_cut, start=start, window=model.window)
