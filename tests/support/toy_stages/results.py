"""Give ready results, for tests of the report."""

from __future__ import annotations

from typing import Any

from ssmpipe.contract import Context, Port, Stage, StageConfig
from ssmpipe.core.mesh.trimesh import TriMesh


class Config(StageConfig):
    """Options of ``results``: none."""


def run(mesh: dict[str, TriMesh], *, cfg: Config, ctx: Context) -> dict[str, Any]:
    from tests.support.small_run import small_run

    made = small_run(ids=tuple(mesh), n=7, n_modes=2)
    return {port.slot: getattr(made, port.slot) for port in STAGE.outputs}


STAGE = Stage(
    name="results",
    scope="cohort",
    version=1,
    config=Config,
    run=run,
    inputs=(Port("mesh", "trimesh"),),
    outputs=(
        Port("correspondence", "correspondence"),
        Port("model", "model"),
        Port("measures", "table"),
        Port("landmark_transfer", "table"),
        Port("history", "table", volatile=True),
        Port("certificate", "json"),
    ),
)
