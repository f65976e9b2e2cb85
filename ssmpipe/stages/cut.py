"""Cut a tube open along a line from one opening to the other."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from ssmpipe.contract import Context, Landmarks, Port, Stage, StageConfig
from ssmpipe.core.mesh.topology import loop_length
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.parameterize.generatrix import cut_tube, rims_of

ROLES = ("opening_1", "opening_2", "seam")
Vector = tuple[float, float, float]


class Config(StageConfig):
    """Options of cut."""

    axis: Annotated[
        Vector | None,
        Field(
            description="From opening 1 to opening 2 where no landmarks have these roles, in the aligned frame [-]; null takes the "
            "longer rim as opening 1."
        ),
    ] = None
    seam_direction: Annotated[
        Vector,
        Field(
            description="Side of both rims on which the cut ends where no landmark has the role seam, in the aligned frame [-]; of the "
            "principal axes, y is on the same side in a mirror image, z is not."
        ),
    ] = (0.0, 1.0, 0.0)
    path: Annotated[
        Literal["edges", "geodesic"],
        Field(
            description="Line of the cut. edges: the shortest path of edges of the mesh; geodesic: straightened across the faces, which "
            "get new edges along it, so that the seam depends less on the triangles."
        ),
    ] = "edges"

    @model_validator(mode="after")
    def _consistent(self) -> Config:
        if not any(self.seam_direction) or (self.axis is not None and not any(self.axis)):
            raise ValueError("seam_direction and axis must not be zero vectors")
        return self


def run(mesh: TriMesh, landmarks: Landmarks | None = None, *, cfg: Config, ctx: Context) -> dict[str, Any]:
    """Cut one shape; see :mod:`ssmpipe.core.parameterize.generatrix`."""
    marks = landmarks if landmarks is not None else Landmarks()
    first, second, through = (marks.role(role) for role in ROLES)
    axis = None if cfg.axis is None else np.array(cfg.axis)
    rim_1, rim_2, clear = rims_of(mesh, (first, second), axis)
    if clear < (0.05 if axis is None else 0.3):
        why = "are equally long" if axis is None else "lie across cut.axis"
        ctx.warn(
            f"the two rims {why}, so which one is opening 1 is nearly arbitrary; set cut.axis along the tube, or assign landmarks to "
            "opening_1 and opening_2"
        )
    made, clear = cut_tube(mesh, (rim_1, rim_2), through=through, side=np.array(cfg.seam_direction), path_by=cfg.path)
    if clear < 0.3:
        ctx.warn(
            "cut.seam_direction runs nearly along the tube at one of its rims, so the place of the seam is nearly arbitrary; choose a "
            "direction across the tube, or assign a landmark to seam"
        )
    ctx.metric("seam_from", "direction" if through is None else "landmark")
    ctx.metric("seam_mm", made.length)
    ctx.metric("rim_1_mm", loop_length(mesh, rim_1))
    ctx.metric("rim_2_mm", loop_length(mesh, rim_2))
    ctx.metric("n_vertices", made.mesh.n_vertices)
    ctx.metric("n_faces", made.mesh.n_faces)
    return {"mesh": made.mesh, "seam": made.seam}


STAGE = Stage(
    name="cut",
    scope="shape",
    version=2,
    config=Config,
    run=run,
    inputs=(Port("mesh", "trimesh"), Port("landmarks", "landmarks", optional=True)),
    outputs=(Port("mesh", "trimesh"), Port("seam", "seam")),
    methods="Tubes were cut open along a shortest path ({path}) from one opening to the other.",
    cites=("li2015",),
    roles=ROLES,
)
