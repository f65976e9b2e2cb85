"""Bring new scans into a model that stays as it is: the same chain, then coefficients, distances and meshes per patient."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ssmpipe import __version__
from ssmpipe.contract import Table
from ssmpipe.core.align.rigid import apply
from ssmpipe.core.arrays import Bools, Floats
from ssmpipe.core.correspondence.choices import boundary_of, closes, start_of
from ssmpipe.core.correspondence.newcomer import FixedCohort, Newcomer, bring_in
from ssmpipe.core.correspondence.optimize import EngineOptions
from ssmpipe.core.errors import ConfigError
from ssmpipe.core.evaluation.quality import Geometry, facing
from ssmpipe.core.mesh.distance import signed_point_to_mesh
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.model.posterior import NOWHERE, Observations, posterior
from ssmpipe.core.model.remainder import LeaveOneOut, Remainder, farthest_first, fit_remainder, leave_one_out
from ssmpipe.core.model.shape_model import ShapeModel
from ssmpipe.core.outline.distance import point_to_segments
from ssmpipe.core.outline.outline import Outline, edge_indices
from ssmpipe.core.spline.poles import surface_topology
from ssmpipe.core.spline.surface import BSplineSurface
from ssmpipe.io.arrays import write_npz
from ssmpipe.io.codecs import load_artifact, read_json, write_json
from ssmpipe.io.landmarks import read_landmarks
from ssmpipe.io.mesh_formats import vtp
from ssmpipe.io.meshes import MESH_SUFFIXES, write_mesh
from ssmpipe.io.outlines import write_outline
from ssmpipe.io.tables import read_cohort, write_table
from ssmpipe.report.projected import INDEX, ProjectedPage, build_projected
from ssmpipe.report.projected_index import ProjectedIndex, build_index
from ssmpipe.runner.batch import Batch, Closing, Failure, Job, Outcome
from ssmpipe.runner.chain import chain_as_steps, optimize_options, read_content
from ssmpipe.runner.console import Console
from ssmpipe.runner.disk import disk_errors, write_atomically
from ssmpipe.runner.fingerprint import file_digest
from ssmpipe.runner.lock import locked
from ssmpipe.runner.plan import SCAN, Plan, make_plan
from ssmpipe.runner.record import write_failures
from ssmpipe.runner.registry import Registry
from ssmpipe.runner.run import INTERNAL, OK, QUARANTINED, SCRATCH, default_jobs
from ssmpipe.runner.sources import (
    IMAGE_SUFFIXES,
    OUTLINE_SUFFIXES,
    SPLINE_SUFFIX,
    Source,
    by_id,
    find_sources,
    scan_files,
)
from ssmpipe.runner.suggest import count
from ssmpipe.runner.workspace import Workspace
from ssmpipe.use.completing import PARTIAL, Fragment, complete_fragment, rank, summary
from ssmpipe.use.model import Model

STEP = "project"
_SEEN_POINTS = 300


@dataclass(frozen=True)
class ProjectOptions:
    """What the command line says.

    Parameters
    ----------
    landmarks, cohort : Path, optional
        Named points per scan; a table with ``id`` and ``side``.
    side : {"L", "R", None}
        Of all scans that the table does not tell.
    jobs : int, optional
    timeout_s : float, optional
        For one scan.
    partial : bool
        Whether scans are fragments, which are completed instead of taken through the chain.
    fill : bool
        The same, and every fragment is also written with its openings filled.
    """

    landmarks: Path | None = None
    cohort: Path | None = None
    side: str | None = None
    jobs: int | None = None
    timeout_s: float | None = 3600.0
    partial: bool = False
    fill: bool = False


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


@dataclass
class ProjectResult:
    """What came out: exit code, rows of the table by id, failures, and by id what was warned of: stage and sentence."""

    exit_code: int
    rows: dict[str, dict[str, Any]] = field(default_factory=dict)
    failures: dict[str, Failure] = field(default_factory=dict)
    warnings: dict[str, list[tuple[str, str]]] = field(default_factory=dict)


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


def project_scans(
    model: Model, scans: Sequence[Path], out: Path, options: ProjectOptions, console: Console
) -> ProjectResult:
    """Project scans into a model and write everything about them into ``out``.

    Every scan is a task of its own: what comes out for it depends on the scan and the model, not on the other scans.

    Raises
    ------
    ConfigError
        If the model carries no chain, or scans, tables or options do not fit.
    LockHeldError
        If another command writes into ``out``.
    DiskError
        If ``out`` cannot be written.
    """
    content = read_content(model.shape_model.chain, model.path.name)
    registry = Registry.default()
    sources, warnings = _sources(scans, content, options)
    if any(page_path(out, source.id) == out / INDEX for source in sources):
        raise ConfigError(
            f"'{Path(INDEX).stem}' cannot be the id of a patient, {INDEX} lists them all", "rename the scan"
        )
    kinds = sources[0].kinds
    if options.partial and (sources[0].kind != "mesh" or not len(model.shape_model.faces)):
        raise ConfigError("only surfaces can be completed", "leave out --partial and --fill")
    with locked(out):
        scratch = out / SCRATCH
        with disk_errors():
            shutil.rmtree(scratch, ignore_errors=True)
            scratch.mkdir(parents=True)
            if options.partial or "surface" in kinds:
                plan = Plan(())
            else:
                assert model.shape_model.chain is not None
                steps, more = chain_as_steps(model.shape_model.chain, content, registry, out / "common", tuple(kinds))
                plan, warnings = make_plan(steps, kinds), [*warnings, *more]
        for warning in warnings:
            console.warn(warning)
        return _run(model, sources, plan, out, content, options, console, registry)


def _run(
    model: Model,
    sources: Sequence[Source],
    plan: Plan,
    out: Path,
    content: Mapping[str, Any],
    options: ProjectOptions,
    console: Console,
    registry: Registry,
) -> ProjectResult:
    target = Target.of(model, content)
    by_shape = {source.id: source for source in sources}
    workspace = Workspace(out, plan, by_shape, int(content["seed"]), registry, out / SCRATCH, joins=True)
    names = tuple(step.id for step in plan.steps)
    closing = Closing(STEP, partial(project_shape, target))
    if options.partial:
        closing = Closing("complete", partial(complete_shape, target, content["steps"], options.fill))
    jobs = [Job(workspace.only([s.id]), names, s.id, (s.id,), closing=closing) for s in sources]
    result = ProjectResult(OK)
    may_be_a_part = not options.partial and sources[0].kind == "mesh" and len(model.shape_model.faces) > 0
    with disk_errors():
        for source in sources:  # what an earlier call wrote must not stay when this one fails
            shutil.rmtree(patient_folder(out, source.id), ignore_errors=True)
            page_path(out, source.id).unlink(missing_ok=True)

    def finished(job: Job, outcome: Outcome) -> None:
        for record in outcome.records:
            for warning in record.warnings if record.status == "done" else ():
                console.warn(f"{record.shape}, {record.step}: {warning}")
        if outcome.failure is not None:
            failure = outcome.failure
            if may_be_a_part:
                failure = _with_hint(failure, outcome)
            result.failures[failure.shape] = failure
            console.error(f"failed: {failure.line}")
            return
        told = [(record.step, text) for record in outcome.records for text in record.warnings]
        result.warnings[str(job.shape)] = told
        row = read_json(patient_folder(out, str(job.shape)) / "projection.json")
        result.rows[str(job.shape)] = row
        console.say(_line(row, target.unit))

    batch = Batch(
        jobs=min(options.jobs or default_jobs(), len(jobs)),
        scratch=workspace.scratch,
        timeout_s=options.timeout_s,
        on_event=console.event,
    )
    with console, batch:
        console.begin("project", len(jobs) * (len(names) + 1))
        batch.run(jobs, finished)
    failures = {
        i: {"stage": f.stage, "file": f.file, "error": f.error, "remedy": f.remedy} for i, f in result.failures.items()
    }
    with disk_errors():
        write_failures(out, failures)
        write_table(out / "scores.csv", scores_table(result.rows, len(target.model.variances), target.unit))
        write_json(out / "project.json", _record(model, target, sources, result))
        write_atomically(out / INDEX, build_index(_index(out, target, sources, result, failures)))
        shutil.rmtree(workspace.scratch, ignore_errors=True)
    result.exit_code = exit_code_of(result)
    return result


def exit_code_of(result: ProjectResult) -> int:
    """Return the exit code: 3 where a scan failed, a map is not proved one-to-one, or holes that were to be filled are left.

    Examples
    --------
    >>> exit_code_of(ProjectResult(0, {"a": {"certificate": {"status": "partial"}, "holes_left": 1}}))
    3
    """
    if result.failures and all(f.internal for f in result.failures.values()) and not result.rows:
        return INTERNAL
    unproved = any(row["certificate"]["status"] not in ("proved", PARTIAL) for row in result.rows.values())
    holes = any(row.get("holes_left") for row in result.rows.values())
    return QUARANTINED if result.failures or unproved or holes else OK


def _with_hint(failure: Failure, outcome: Outcome) -> Failure:
    """Return the failure with the remedy for a fragment: the file could be read, and the stages made nothing of it.

    Examples
    --------
    >>> small = Failure("a", "orient", "a.ply", "bounding box diagonal is 60 mm, femur-distal expects 90-700 mm", "check the file")
    >>> _with_hint(small, Outcome(())).remedy
    'check the file; if it shows a part only: --partial'
    """
    was_read = bool(outcome.records) or "bounding box" in failure.error
    if failure.internal or not was_read:
        return failure
    return replace(failure, remedy="; ".join(x for x in (failure.remedy, "if it shows a part only: --partial") if x))


def _sources(
    scans: Sequence[Path], content: Mapping[str, Any], options: ProjectOptions
) -> tuple[list[Source], list[str]]:
    try:
        found = scan_files(list(scans), (*MESH_SUFFIXES, *OUTLINE_SUFFIXES, *IMAGE_SUFFIXES, SPLINE_SUFFIX))
    except ConfigError as error:
        raise ConfigError(error.fact, "check the path") from None
    files = by_id(found)
    marks = None
    if options.landmarks is not None:
        marks = dict(read_landmarks(options.landmarks))
        if len(files) == len(marks) == 1:
            marks = dict(zip(files, marks.values(), strict=True))
        missing = sorted(set(files) - set(marks))
        if missing and len(missing) == len(files):
            raise ConfigError(
                f"{options.landmarks} has no entry '{missing[0]}'", f"it has: {', '.join(sorted(marks)[:5])}"
            )
    rows = dict(read_cohort(options.cohort)) if options.cohort is not None else {}
    rows = {i: {"side": options.side or "", **rows.get(i, {})} for i in files}
    diagonal = content.get("diagonal_mm")
    if diagonal and options.partial:
        diagonal = (0.0, diagonal[1])  # a part may be small
    sources, warnings = find_sources(
        files,
        cohort=rows,
        landmarks=marks,
        units=content["units"],
        roles=dict(content.get("roles") or {}),
        diagonal_mm=tuple(diagonal) if diagonal else None,
        anatomy=content.get("anatomy") or "",
        tolerance_mm=float(content.get("tolerance_mm", 20.0)),
    )
    mixed = sorted({s.kind for s in sources})
    if len(mixed) > 1:
        raise ConfigError(f"{' and '.join(mixed)} files cannot be projected together", "use one call for each kind")
    if mixed[0] not in (content.get("kind"), "spline"):
        raise ConfigError(
            f"the model was built from {content.get('kind')} files, {sources[0].path.name} is of the kind {mixed[0]}",
            "give scans of the same kind",
        )
    return sources, warnings


# --- one patient, in a child process -----------------------------------------------------------------------------------


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
        observed = _moved(observed, to_model)
    written = Projection.of(target, _poles_merged(new, model), new, new.matrix @ transform, observed)
    source = workspace.sources[shape]
    written.write(patient_folder(workspace.out, shape), shape, source.side)
    told = [*_stage_warnings(workspace, shape), *((STEP, text) for text in warnings)]
    return warnings + write_page(workspace.out, shape, lambda: written.page(source, told))


def _stage_warnings(workspace: Workspace, shape: str) -> list[tuple[str, str]]:
    manifests = [(step.id, workspace.manifest(workspace.folder(step, shape))) for step in workspace.plan.steps]
    return [(name, text) for name, manifest in manifests if manifest is not None for text in manifest.warnings]


def page_path(out: Path, shape: str) -> Path:
    """Return where the page of one patient is written."""
    return out / f"{shape}.html"


def write_page(out: Path, shape: str, make: Callable[[], ProjectedPage]) -> list[str]:
    """Write the page of one patient; return a warning where that cannot be done, since the numbers are there all the same."""
    try:
        text = build_projected(make())
    except Exception as error:
        return [f"its page could not be made ({type(error).__name__}: {error}); the numbers are in patients/{shape}"]
    write_atomically(page_path(out, shape), text)
    return []


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
        **_about(target, source),
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


def _about(target: Target, source: Source) -> dict[str, Any]:
    """Return what the pages of scans and of fragments have in common."""
    return {
        "id": source.id,
        "file": source.path.name,
        "side": source.side or "",
        "unit": target.unit,
        "version": __version__,
        "model_name": target.name,
        "model": target.model,
        "mahalanobis": target.others.mahalanobis,
        "residuals": _rms_each(target.others.residuals),
    }


def _rms_each(residuals: Floats) -> Floats:
    return np.asarray(np.sqrt((residuals**2).sum(axis=2).mean(axis=1)))


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


def _moved(shape: TriMesh | Outline, matrix: Floats) -> TriMesh | Outline:
    if isinstance(shape, Outline):
        return Outline(shape.points @ matrix[:2, :2].T + matrix[:2, 3], shape.closed)
    faces = shape.faces if np.linalg.det(matrix[:3, :3]) > 0 else shape.faces[:, ::-1]
    return TriMesh(apply(matrix, shape.vertices), faces)


def _poles_merged(new: Newcomer, model: ShapeModel) -> Floats:
    """Return the points with one place per pole, to the bit, as the model has them."""
    points = new.points.copy()
    if model.topology in ("cone", "closed"):
        field_ = points.reshape(*model.grid, -1)
        field_[:, -1] = field_[:1, -1]
        if model.topology == "closed":
            field_[:, 0] = field_[:1, 0]
    return points


@dataclass(frozen=True, eq=False)
class Projection:
    """One shape in the model, in numbers.

    Parameters
    ----------
    target : Target
    points : (n_P, d)
        Corresponded, in the frame of the model [mm].
    scores, deviations : (n_modes,)
        Coefficients and their uncertainty [standard deviations of the model].
    covariance : (n_modes, n_modes)
    reconstruction : (n_P, d)
        The instance of the model at the scores.
    matrix : (4, 4)
        From the scan to the frame of the model.
    observed : TriMesh or Outline, optional
        The processed scan in the frame of the model.
    new : Newcomer
    """

    target: Target
    points: Floats
    scores: Floats
    deviations: Floats
    covariance: Floats
    reconstruction: Floats
    matrix: Floats
    observed: TriMesh | Outline | None
    new: Newcomer

    @classmethod
    def of(
        cls, target: Target, points: Floats, new: Newcomer, matrix: Floats, observed: TriMesh | Outline | None
    ) -> Projection:
        """Project corresponded points and say how sure the coefficients are."""
        model = target.model
        scores = model.project(points)
        few = farthest_first(model.mean, _SEEN_POINTS)
        seen = Observations.of_places(few, points[few])
        covariance = posterior(model, target.remainder, seen, deviation_at=NOWHERE).covariance
        return cls(
            target,
            points,
            scores,
            np.sqrt(np.diagonal(covariance)),
            covariance,
            model.instance(scores),
            matrix,
            observed,
            new,
        )

    def numbers(self, shape: str, side: str | None) -> dict[str, Any]:
        """Return what the table and the page say of the shape."""
        others = self.target.others
        distance = float(np.linalg.norm(self.scores))
        residual = _rms(self.points - self.reconstruction)
        training = _rms_each(others.residuals)
        verdict = self.new.certificate
        to_scan, to_model = self.distances()
        covered = self.covered()
        return {
            "id": shape,
            "side": side or "",
            "scores": self.scores,
            "deviations": self.deviations,
            "mahalanobis": distance,
            "mahalanobis_p": rank(distance, others.mahalanobis),
            "residual_rms_mm": residual,
            "residual_p": rank(residual, training),
            **summary("to_scan", to_scan),
            **summary("from_scan", to_model[covered]),
            "beyond_share": 1.0 - float(covered.mean()) if len(covered) else 0.0,
            "description_length_before": self.new.description_length[0],
            "description_length_after": self.new.description_length[1],
            "certificate": {
                "quantity": "lower bound of det dD/du over the whole parameter domain",
                "lower_bound": verdict.lower_bound,
                "smallest_value_seen": verdict.upper_bound_of_minimum,
                "status": verdict.verdict,
                "subdivisions": verdict.n_subdivisions,
            },
        }

    def distances(self) -> tuple[Floats, Floats]:
        """Return signed distances from the reconstruction to the scan and back [mm], positive where the scan lies outside.

        Zero on the way back where the model does not cover the scan.
        """
        if self.observed is None:
            return np.empty(0), np.empty(0)
        if isinstance(self.observed, Outline):
            closed = self.target.model.topology == "curve-closed"
            edges = edge_indices(len(self.reconstruction), closed)
            return (
                point_to_segments(self.reconstruction, self.observed.points, self.observed.edges)[0],
                point_to_segments(self.observed.points, self.reconstruction, edges)[0],
            )
        model_surface = TriMesh(self.reconstruction, self.target.model.faces)
        to_model = signed_point_to_mesh(self.observed.vertices, model_surface)
        return -signed_point_to_mesh(self.reconstruction, self.observed), np.where(self.covered(), to_model, 0.0)

    def covered(self) -> Bools:
        """Say which vertices of the scan the model covers: all, but those beyond its rim where the rims of the model are free."""
        if isinstance(self.observed, TriMesh) and self.target.model.window is not None:
            return facing(self.observed.vertices, Geometry(self.reconstruction, self.target.model.faces))
        n = (
            0
            if self.observed is None
            else len(self.observed.points if isinstance(self.observed, Outline) else self.observed.vertices)
        )
        return np.ones(n, dtype=bool)

    def page(self, source: Source, warnings: Sequence[tuple[str, str]]) -> ProjectedPage:
        """Return what the page of the shape shows."""
        to_scan, to_model = self.distances()
        mesh = self.observed if isinstance(self.observed, TriMesh) else None
        return ProjectedPage(
            **_about(self.target, source),
            numbers=self.numbers(source.id, source.side),
            points=self.points,
            reconstruction=self.reconstruction,
            matrix=self.matrix,
            map_name="Distance of the scan from its reconstruction",
            map_values=to_scan if len(to_scan) else None,
            scan=Geometry(mesh.vertices, mesh.faces) if mesh is not None else None,
            scan_distance=to_model if mesh is not None else None,
            warnings=warnings,
        )

    def write(self, folder: Path, shape: str, side: str | None) -> None:
        """Write meshes, arrays and numbers; everything in scan coordinates and units, distances in mm."""
        back = np.asarray(np.linalg.inv(self.matrix))
        model = self.target.model
        with disk_errors():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            to_scan, to_model = self.distances()
            d = self.points.shape[1]
            in_scan = {
                name: points @ back[:d, :d].T + back[:d, 3]
                for name, points in (("corresponded", self.points), ("reconstruction", self.reconstruction))
            }
            if d == 2:
                for name, points in in_scan.items():
                    write_outline(folder / f"{name}.csv", Outline(points, model.topology == "curve-closed"))
            elif len(model.faces):
                faces = model.faces if np.linalg.det(back[:3, :3]) > 0 else model.faces[:, ::-1]
                for name, points in in_scan.items():
                    write_mesh(folder / f"{name}.ply", TriMesh(points, faces))
                data = {"residual_mm": np.linalg.norm(self.points - self.reconstruction, axis=1)}
                if len(to_scan):
                    data = {"distance_mm": to_scan, **data}
                (folder / "reconstruction.vtp").write_bytes(vtp.dump(in_scan["reconstruction"], faces, data))
                if isinstance(self.observed, TriMesh):
                    scan = _moved(self.observed, back)
                    assert isinstance(scan, TriMesh)
                    (folder / "scan.vtp").write_bytes(vtp.dump(scan.vertices, scan.faces, {"distance_mm": to_model}))
            write_npz(
                folder / "projection.npz",
                {
                    "scores": self.scores,
                    "scores_covariance": self.covariance,
                    "points": self.points,
                    "points_scan": in_scan["corresponded"],
                    "reconstruction": self.reconstruction,
                    "transform": self.matrix,
                    "parameters": self.new.parameters,
                    "coefficients": self.new.coefficients,
                    "distance_to_scan": to_scan,
                    "distance_from_scan": to_model,
                },
            )
            write_json(folder / "projection.json", self.numbers(shape, side))


def _rms(offsets: Floats) -> float:
    return float(np.sqrt((offsets**2).sum(axis=-1).mean()))


# --- tables --------------------------------------------------------------------------------------------------------


def scores_table(rows: Mapping[str, Mapping[str, Any]], n_modes: int, unit: str = "mm") -> Table:
    """Return one row per patient: coefficients as in the ``scores.csv`` of a run, their uncertainty, distances."""
    ids = sorted(rows)
    columns: dict[str, list[Any]] = {"id": list(ids)}
    for m in range(n_modes):
        columns[f"mode_{m + 1:02d}"] = [rows[i]["scores"][m] for i in ids]
    for m in range(n_modes):
        columns[f"mode_{m + 1:02d}_sd"] = [rows[i]["deviations"][m] for i in ids]
    plain = ["side", "mahalanobis", "mahalanobis_p", "residual_rms_mm", "residual_p"]
    plain += [f"{d}_{w}_mm" for d in ("to_scan", "from_scan") for w in ("mean", "median", "p95", "max")]
    for name in plain:
        columns[name] = ["" if rows[i].get(name) is None else rows[i][name] for i in ids]
    if any("seen_share" in rows[i] for i in ids):
        for name in ("seen_share", "expected_error_mm"):
            columns[name] = ["" if rows[i].get(name) is None else rows[i][name] for i in ids]
    columns["certificate"] = [rows[i]["certificate"]["status"] for i in ids]
    note = (
        "modes and their sd in standard deviations of the model; _p: share of the training shapes, each in the model of the others, "
        "that lie as far out; to_scan: from the reconstruction to the scan, from_scan: back"
    )
    if unit != "mm":
        note += f"; columns whose names end in _mm are in {unit}"
    return Table(columns, note)


def _line(row: Mapping[str, Any], unit: str) -> str:
    text = f"{row['id']}: Mahalanobis {row['mahalanobis']:.2f} (p {row['mahalanobis_p']:.2g}), "
    if row["certificate"]["status"] == PARTIAL:
        text += f"{100 * row['seen_share']:.0f} % seen, {row['from_scan_mean_mm']:.3g} {unit} from the fragment"
        expected = row.get("expected_error_mm")
        text += f", missing part expected within {expected:.2g} {unit}" if expected is not None else ""
        return text + (f", {count(row['holes_left'], 'hole')} left open" if row.get("holes_left") else "")
    text += f"residual {row['residual_rms_mm']:.3g} {unit}"
    if row.get("to_scan_mean_mm") is not None:
        text += (
            f", reconstruction {row['to_scan_mean_mm']:.3g} {unit} from the scan (95 %: {row['to_scan_p95_mm']:.3g})"
        )
    return text + f", {row['certificate']['status']}"


def _index(
    out: Path,
    target: Target,
    sources: Sequence[Source],
    result: ProjectResult,
    failures: Mapping[str, Mapping[str, str]],
) -> ProjectedIndex:
    return ProjectedIndex(
        name=out.resolve().name,
        unit=target.unit,
        version=__version__,
        model_name=target.name,
        numbers=result.rows,
        files={source.id: source.path.name for source in sources},
        pages={i: page_path(out, i).name for i in result.rows if page_path(out, i).is_file()},
        mahalanobis=target.others.mahalanobis,
        residuals=_rms_each(target.others.residuals),
        warnings=result.warnings,
        failures=failures,
    )


def _record(model: Model, target: Target, sources: Sequence[Source], result: ProjectResult) -> dict[str, Any]:
    others = target.others
    return {
        "ssmpipe_version": __version__,
        "model": {
            "file": model.path.name,
            "sha256": file_digest(model.path),
            "n_shapes": len(model.ids),
            "n_modes": len(model.variances),
        },
        "training": {
            i: {"mahalanobis": d, "residual_rms_mm": _rms(r)}
            for i, d, r in zip(model.ids, others.mahalanobis, others.residuals, strict=True)
        },
        "remainder": {
            "variance_mm2": target.remainder.variance,
            "length_mm": target.remainder.length,
            "noise_mm2": target.remainder.noise,
        },
        "scans": {s.id: {"file": s.path.name, "side": s.side} for s in sources},
        "ok": sorted(result.rows),
        "failed": sorted(result.failures),
    }
