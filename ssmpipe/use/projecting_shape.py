"""One patient in a child process: projected or completed, and its folder and page written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.choices import closes
from ssmpipe.core.correspondence.newcomer import FixedCohort, Newcomer, bring_in
from ssmpipe.core.errors import ConfigError
from ssmpipe.core.evaluation.quality import Geometry
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.model.shape_model import ShapeModel
from ssmpipe.core.outline.outline import Outline
from ssmpipe.core.spline.poles import surface_topology
from ssmpipe.core.spline.surface import BSplineSurface
from ssmpipe.io.codecs import load_artifact
from ssmpipe.report.projected import ProjectedPage
from ssmpipe.runner.plan import SCAN
from ssmpipe.runner.workspace import Workspace
from ssmpipe.use.completing import Fragment, complete_fragment
from ssmpipe.use.projected_pages import about, write_page
from ssmpipe.use.projection import Projection, moved
from ssmpipe.use.target import Target

STEP = "project"


def patient_folder(out: Path, shape: str) -> Path:
    """Return where everything about one patient is written."""
    return out / "patients" / shape


def project_shape(target: Target, workspace: Workspace, shape: str) -> list[str]:
    """Project one shape whose chain is through, and write its folder; return warnings."""
    model = target.model
    scan: dict[str, Any] = {}

    def artifact(slot: str, before: int = 1_000_000) -> Any:
        makers = [s for s in workspace.plan.steps if s.number < before and any(p.slot == slot for p in s.outputs)]
        if makers:
            folder = workspace.folder(makers[-1], shape)
            manifest = workspace.manifest(folder)
            assert manifest is not None
            output = manifest.outputs.get(slot)
            if output is not None:
                return load_artifact(output.kind, slot, folder, list(output.files))
        if not scan:
            scan.update(workspace.sources[shape].load())
        return scan.get(slot)

    spline, transform = artifact("surface"), artifact("transform")
    _check_topology(spline, model)
    cohort = FixedCohort(
        model.training_points,
        model.grid,
        closes=closes(model.topology),
        options=target.options,
        normals=model.normals,
        normal_scale=model.normal_scale,
    )
    found = bring_in(spline, cohort)
    new = found.value
    warnings = []
    if found.status == "out-of-iterations":
        warnings.append("the optimization stopped before it settled; the model's optimize.max_iterations is small")
    if new.certificate.verdict != "proved":
        warnings.append("the reparameterization is not proved one-to-one; look at the corresponded surface")
    observed, own = _observed_surface(workspace, artifact)
    if observed is not None:
        to_model = new.matrix @ transform @ np.linalg.inv(own)
        observed = moved(observed, to_model)
    written = Projection.of(target, _poles_merged(new, model), new, new.matrix @ transform, observed)
    source = workspace.sources[shape]
    written.write(patient_folder(workspace.out, shape), shape, source.side)
    told = [*_stage_warnings(workspace, shape), *((STEP, text) for text in warnings)]
    return warnings + write_page(workspace.out, shape, lambda: written.page(source, told))


def _stage_warnings(workspace: Workspace, shape: str) -> list[tuple[str, str]]:
    manifests = [(step.id, workspace.manifest(workspace.folder(step, shape))) for step in workspace.plan.steps]
    return [(name, text) for name, manifest in manifests if manifest is not None for text in manifest.warnings]


def complete_shape(
    target: Target, steps: Sequence[Mapping[str, Any]], fill: bool, workspace: Workspace, shape: str
) -> list[str]:
    """Complete one fragment, and write its folder; return warnings."""
    source = workspace.sources[shape]
    scan = source.load()
    fragment = Fragment(scan["mesh"], scan["transform"], source.side, steps, fill)
    folder = patient_folder(workspace.out, shape)
    part = complete_fragment(target.model, target.remainder, target.others, fragment, folder, shape)
    warnings = [*scan["warnings"], *part.warnings]
    page = ProjectedPage(
        **about(target, source),
        numbers=part.numbers,
        points=part.points,
        matrix=part.matrix,
        map_name="Standard deviation of the completed surface",
        map_values=part.deviation,
        scan=Geometry(part.placed.vertices, part.placed.faces),
        scan_distance=part.distance,
        warnings=[("complete", text) for text in warnings],
    )
    return warnings + write_page(workspace.out, shape, lambda: page)


def _check_topology(spline: Any, model: ShapeModel) -> None:
    kind: str
    if isinstance(spline, BSplineSurface):
        kind = surface_topology(spline)
    else:
        ends = spline.control_points[[0, -1]]
        kind = "curve-closed" if np.allclose(ends[0], ends[1], rtol=0, atol=1e-9) else "curve-open"
    if kind != model.topology:
        raise ConfigError(f"the shape is a {kind}, the model is one of {model.topology} shapes", "check the scan")


def _observed_surface(workspace: Workspace, artifact: Any) -> tuple[TriMesh | Outline | None, Floats]:
    """Return the last mesh (or outline) before the parameterization or the fit, and the transform that belongs to it."""
    for step in workspace.plan.steps:
        for slot in ("mesh", "contour"):
            maker = step.inputs.get(slot)
            if step.stage in ("parameterize", "fit") and maker is not None:
                number = 1 if maker.step == SCAN else workspace.plan.step(maker.step).number + 1
                return artifact(slot, number), artifact("transform", number)
    return None, np.eye(4)


def _poles_merged(new: Newcomer, model: ShapeModel) -> Floats:
    """Return the points with one place per pole, to the bit, as the model has them."""
    points = new.points.copy()
    if model.topology in ("cone", "closed"):
        field_ = points.reshape(*model.grid, -1)
        field_[:, -1] = field_[:1, -1]
        if model.topology == "closed":
            field_[:, 0] = field_[:1, 0]
    return points
