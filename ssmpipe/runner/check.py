"""Look at every scan before any work: can it be read, what is it, do units, side and landmarks fit, what would refuse it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import TimeoutError as FutureTimeout
from dataclasses import dataclass, replace
from itertools import takewhile
from multiprocessing import get_context
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from ssmpipe.core.errors import SsmpipeError
from ssmpipe.report.sides import unchecked_sides
from ssmpipe.runner.batch import one_thread_environment, quiet_tracker, start_child
from ssmpipe.runner.disk import unwritable
from ssmpipe.runner.estimate import estimate_plan
from ssmpipe.runner.execute import rehearse
from ssmpipe.runner.machine import default_jobs
from ssmpipe.runner.plan import PlannedStep
from ssmpipe.runner.presets import PRESETS
from ssmpipe.runner.project import Project
from ssmpipe.runner.record import resolved_config
from ssmpipe.runner.registry import Registry
from ssmpipe.runner.sources import PLAUSIBLE_MM, TO_MM, Source, check_landmarks, check_size, landmark_distances
from ssmpipe.runner.suggest import count

if TYPE_CHECKING:
    from ssmpipe.runner.console import Console


@dataclass(frozen=True)
class ScanCheck:
    """What one scan is; ``error`` is empty when it can be used.

    Lengths are in mm, or in file units when the config says ``units: none``. Counts are those of the file: ``genus`` is the
    number of handles of the largest component, None where edges are shared by more than two faces.
    """

    id: str
    file: str
    side: str | None = None
    n_vertices: int | None = None
    n_faces: int | None = None
    n_components: int | None = None
    n_loops: int | None = None
    genus: int | None = None
    size: tuple[float, ...] | None = None
    n_landmarks: int = 0
    farthest: float | None = None
    warnings: tuple[str, ...] = ()
    error: str = ""


def inspect(
    source: Source, steps: Sequence[PlannedStep] = (), registry: Registry | None = None, seed: int = 0
) -> ScanCheck:
    """Read a scan, describe it, and take it through the first stages; what is wrong ends in ``error`` or ``warnings``.

    Parameters
    ----------
    source : Source
    steps : sequence of PlannedStep
        The chain; those before the first that needs other shapes are run in memory, the others only named by their roles.
    registry : Registry, optional
    seed : int
    """
    registry = registry or Registry.default()
    found = ScanCheck(source.id, source.path.name, source.side, n_landmarks=len(source.landmarks or {}))
    try:
        if source.kind == "outline":
            found = _inspect_outline(source, found)
        elif source.kind == "image":
            found = _inspect_image(source, found)
        elif source.kind == "mesh":
            found = _inspect_mesh(source, found)
        if found.error:
            return found
        alone = list(takewhile(lambda step: step.scope == "shape" and not step.prepared, steps))
        refusal = rehearse(source, alone, registry, seed)
        names = [step.id for step in steps]
        later = steps[names.index(refusal[0]) + 1 if refusal else len(alone) :]
        errors = [f"{refusal[0]}: {refusal[1]}"] if refusal else []
        return replace(found, error="; ".join([*errors, *_missing_roles(source, later, registry)]))
    except SsmpipeError as error:
        return replace(found, error=str(error))
    except OSError as error:
        return replace(found, error=f"the file cannot be read ({error.strerror or error})")
    except (Exception, SystemExit) as error:
        return replace(found, error=f"internal error {type(error).__name__}: {error}")


def _missing_roles(source: Source, steps: Sequence[PlannedStep], registry: Registry) -> list[str]:
    """Return what the stages will say of landmarks that this shape lacks, for the roles that they read."""
    from ssmpipe.contract import Landmarks

    marks = Landmarks(dict.fromkeys(source.landmarks or {}, ()), source.roles)  # type: ignore[arg-type]
    errors = []
    for step in steps:
        for role in registry.load(step.stage).roles:
            try:
                marks.role(role)
            except SsmpipeError as error:
                errors.append(f"{step.id}: {error}")
    return errors


def _inspect_mesh(source: Source, found: ScanCheck) -> ScanCheck:
    import numpy as np

    from ssmpipe.core.mesh.topology import boundary_loops, compact, face_components, genus, is_edge_manifold
    from ssmpipe.core.mesh.trimesh import TriMesh
    from ssmpipe.io.meshes import read_mesh

    factor = TO_MM[source.units]
    mesh = read_mesh(source.path)
    mesh = TriMesh(mesh.vertices * factor, mesh.faces)
    size = np.ptp(mesh.vertices, axis=0)
    component = face_components(mesh.faces)
    counts = np.bincount(component)
    warnings = []
    if len(counts) > 1:
        small = len(mesh.faces) - int(counts.max())
        warnings.append(f"{len(counts)} components; {small} faces lie outside the largest")
    main = compact(mesh, component == int(counts.argmax()))
    n_loops = handles = None
    if is_edge_manifold(main.faces):
        n_loops, handles = len(boundary_loops(main.faces)), genus(main.faces)
        if handles > 0:
            warnings.append(
                f"{count(handles, 'handle')}; the chain needs a surface without, close them in the segmentation"
            )
    else:
        warnings.append("some edges are shared by more than two faces; repair is needed")
    found = replace(
        found,
        n_vertices=mesh.n_vertices,
        n_faces=mesh.n_faces,
        n_components=len(counts),
        n_loops=n_loops,
        genus=handles,
        size=(float(size[0]), float(size[1]), float(size[2])),
        warnings=tuple(warnings),
    )
    errors = []
    points = {name: factor * np.array(p) for name, p in (source.landmarks or {}).items()}
    distances = landmark_distances(mesh, points)
    found = replace(found, farthest=max(distances.values(), default=None))
    try:
        diagonal = check_size(mesh, source.diagonal_mm, source.anatomy, source.units)
        if source.units != "none" and not PLAUSIBLE_MM[0] <= diagonal <= PLAUSIBLE_MM[1]:
            warnings.append(
                f"bounding box diagonal is {diagonal:.3g} mm with input.units: {source.units}; options in mm would not fit"
            )
        warnings += check_landmarks(mesh, points, source.tolerance_mm, source.units)
    except SsmpipeError as error:
        errors.append(str(error))
    preset = PRESETS.get(source.anatomy)
    if preset is not None and preset.needs_side and source.side is None:
        warnings.append("side is unknown; add a column side (L or R) to the cohort table")
    return replace(found, warnings=tuple(warnings), error="; ".join(errors))


def _inspect_outline(source: Source, found: ScanCheck) -> ScanCheck:
    import numpy as np

    from ssmpipe.core.outline.outline import Outline, crossings
    from ssmpipe.io.outlines import read_outline

    factor = TO_MM[source.units]
    remarks: list[str] = []
    outline = read_outline(source.path, remarks)
    outline = Outline(outline.points * factor, outline.closed)
    n_crossings = len(crossings(outline))
    warnings = remarks + ([f"the outline crosses itself {n_crossings} times"] if n_crossings else [])
    points = {name: factor * np.array(p) for name, p in (source.landmarks or {}).items()}
    found = replace(found, n_vertices=len(outline.points), size=tuple(float(x) for x in np.ptp(outline.points, axis=0)))
    found = replace(found, farthest=max(landmark_distances(outline, points).values(), default=None))
    warnings += check_landmarks(outline, points, source.tolerance_mm, source.units)
    return replace(found, warnings=tuple(warnings))


def _inspect_image(source: Source, found: ScanCheck) -> ScanCheck:
    from ssmpipe.io.images import read_image

    remarks: list[str] = []
    height, width = read_image(source.path, remarks).size
    source.check_inside((height, width))
    return replace(found, size=(float(width), float(height)), warnings=tuple(remarks))


def check_project(project: Project, jobs: int | None = None) -> list[ScanCheck]:
    """Inspect all scans in child processes; one that crashes its reader, or a stage, is named like any other."""
    from pebble import ProcessExpired, ProcessPool

    limits = project.config.limits
    n = min(jobs or default_jobs(), len(project.sources))
    chain = (project.plan.steps, project.registry, project.config.seed)
    checks: list[ScanCheck] = []
    with TemporaryDirectory(prefix="ssmpipe-") as noise, one_thread_environment():
        quiet_tracker()
        pool: Any = ProcessPool(
            max_workers=n,
            initializer=start_child,
            initargs=(limits.memory_mb, f"{noise}/libraries.txt", os.getpid()),
            context=get_context("spawn"),
        )
        with pool:
            futures = [
                (s, pool.schedule(inspect, args=(s, *chain), timeout=limits.timeout_s))
                for s in project.sources.values()
            ]
            for source, future in futures:
                plain = ScanCheck(source.id, source.path.name, source.side)
                try:
                    checks.append(future.result())
                except FutureTimeout:
                    checks.append(replace(plain, error=f"could not be checked within {limits.timeout_s:g} s"))
                except ProcessExpired:
                    checks.append(
                        replace(plain, error="the process crashed; try: open and export the scan in a mesh viewer")
                    )
    return checks


def check_output(project: Project) -> str:
    """Return why the results could not be written, with a remedy; empty when they can."""
    out = project.out
    for folder in (out, *(out / name for name in ("shapes", "cohort") if (out / name).exists())):
        reason = unwritable(folder)
        if reason:
            return f"output: nothing can be written to {folder} ({reason}); try: free space, check permissions, or change `output`"
    return ""


def print_checks(checks: Sequence[ScanCheck], project: Project, console: Console) -> None:
    """Print a table of the scans, then warnings and errors, one line each, and what the group stages will cost."""
    from rich.table import Table as RichTable

    unit = "file units" if project.config.input.units == "none" else "mm"
    table = RichTable(title=f"{project.config.name}: {len(checks)} scans", title_justify="left")
    for name in ("id", "side"):
        table.add_column(name)
    for name in ("vertices", "faces", "parts", "loops", "genus", f"size [{unit}]", "landmarks", f"farthest [{unit}]"):
        table.add_column(name, justify="right")
    table.add_column("verdict")

    def text(value: Any) -> str:
        return "-" if value is None else f"{value:.1f}" if isinstance(value, float) else str(value)

    for c in checks:
        size = " x ".join(f"{x:.4g}" for x in c.size) if c.size else None
        numbers = (c.n_vertices, c.n_faces, c.n_components, c.n_loops, c.genus, size, c.n_landmarks or None, c.farthest)
        verdict = "refused" if c.error else "see below" if c.warnings else "ok"
        table.add_row(c.id, c.side or "-", *(text(x) for x in numbers), verdict)
    console.table(table)
    for warning in project.warnings:
        console.warn(warning)
    for c in checks:
        for warning in c.warnings:
            console.warn(f"{c.id}, {c.file}: {warning}")
    for c in checks:
        if c.error:
            console.error(f"refused: {c.id}, {c.file}: {c.error}")
    note = unchecked_sides(resolved_config(project)["stages"], [c.side for c in checks], project.config.anatomy)
    if note:
        console.warn(note[0].lower() + note[1:])
    n_bad = sum(bool(c.error) for c in checks)
    console.say(f"config is valid; {len(checks) - n_bad} of {len(checks)} scans can be used")
    cost = (
        estimate_plan(project.plan, len(checks) - n_bad) if len(checks) - n_bad >= project.config.min_shapes else None
    )
    if cost is not None:
        console.say(cost.text)
