"""The page of one shape: every stage before and after, what changed, distances, scores, warnings; or why it was set aside."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from scipy.spatial import cKDTree

from ssmpipe.contract import Table
from ssmpipe.core.align.rigid import apply
from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.correspondence import Correspondence
from ssmpipe.core.evaluation.locating import locate
from ssmpipe.core.evaluation.quality import Geometry
from ssmpipe.core.model.shape_model import ShapeModel
from ssmpipe.core.outline.outline import edge_indices
from ssmpipe.report.build import assemble
from ssmpipe.report.figures import AFTER, BEFORE, BONE, SIGNED_STOPS, figure, pixels, png_uri, style, svg_uri
from ssmpipe.report.page import fill
from ssmpipe.report.payload import in_space, landmark_places, quantized, quantized_map, viewer_payload
from ssmpipe.report.pseudonyms import Pseudonyms
from ssmpipe.report.raster import thinned
from ssmpipe.report.section import ReportData, Section
from ssmpipe.report.sections.candidates import candidates_of
from ssmpipe.report.sections.grids import area_factors, grid_nodes, grid_picture
from ssmpipe.report.sections.modes import nice_ceiling
from ssmpipe.report.sections.quality import BLOCKS, WORDS, quality_rows
from ssmpipe.report.sections.summary import Tile, refuted_poles
from ssmpipe.report.sections.viewer import looks_from
from ssmpipe.report.solid import good_view, picture, vertex_normals, view_axes
from ssmpipe.report.units import record_without_mm
from ssmpipe.report.wording import number

CHANGE_STOPS = (BONE, "#e8a33d", "#c4421d", "#6b1022")
CHANGE = LinearSegmentedColormap.from_list("ssmpipe-change", CHANGE_STOPS, N=256)
SAME = 1e-6  # of the size: less is the rounding of files and transforms
_CELLS, _ENOUGH = (
    90,
    7000,
)  # a small picture needs no more: cubes along the diagonal with one point each, and from how many points on
_INCHES, _DPI = 2.2, 100
_SPOT = 0.03  # radius of the spot that marks a place, in diagonals of the shape


@dataclass(frozen=True, eq=False)
class StepShape:
    """What a shape looked like after a step.

    Parameters
    ----------
    key : str
        Folder of the step ("03-trim"), or "scan".
    shape : Geometry or None
        In the frame of the step; None when the step makes none.
    transform : (4, 4) float64
        Scan to that frame.
    pattern : (n_points,) bool, optional
        Squares of a checkerboard that show a parameterization.
    """

    key: str
    shape: Geometry | None
    transform: Floats
    pattern: Any = None


@dataclass(frozen=True, eq=False)
class PatientPage:
    """What the page of one shape shows.

    Parameters
    ----------
    id : str
    record : mapping
        What the runner knows of the run, as for the report.
    steps : sequence of StepShape
        The scan and what every step made of it, in order, as far as it came.
    correspondence, model, certificate, quality
        Of the cohort; absent when there are none.
    reconstructions : mapping, optional
        ``ids``, ``points`` and ``distance`` as ``evaluate`` makes them.
    landmarks : mapping name -> (d,)
        In the frame of the last step.
    before, after : str or None
        Ids of the neighbours.
    """

    id: str
    record: Mapping[str, Any]
    steps: Sequence[StepShape]
    correspondence: Correspondence | None = None
    model: ShapeModel | None = None
    certificate: Mapping[str, Any] = field(default_factory=dict)
    quality: Table | None = None
    reconstructions: Mapping[str, Any] | None = None
    landmarks: Mapping[str, Floats] = field(default_factory=dict)
    before: str | None = None
    after: str | None = None

    @property
    def index(self) -> int | None:
        """Number of the shape in the correspondence; None when it is not part of the model."""
        ids = self.correspondence.ids if self.correspondence is not None else ()
        return ids.index(self.id) if self.id in ids else None

    @property
    def unit(self) -> str:
        """Unit of length."""
        return unit_of(self.record)

    def renamed(self, names: Pseudonyms, record: Mapping[str, Any], results: Mapping[str, Any]) -> PatientPage:
        """Return the same page with neutral names; ``record`` and ``results`` have them already."""
        return replace(
            self,
            id=names.names[self.id],
            record=record,
            correspondence=results["correspondence"],
            model=results["model"],
            certificate=results["certificate"],
            quality=results["quality"],
            reconstructions=results["reconstructions"],
            before=names.names[self.before] if self.before else None,
            after=names.names[self.after] if self.after else None,
        )


def unit_of(record: Mapping[str, Any]) -> str:
    """Return the unit of the lengths of a run."""
    nothing: Any = None
    return ReportData(record, nothing, nothing, nothing, None, nothing, {}).unit


def build_patient(page: PatientPage) -> str:
    """Return the page as one HTML document that works offline; the same input gives the same text."""
    if page.unit != "mm":
        page = replace(page, record=record_without_mm(page.record))
    shape = (page.record.get("shapes") or {}).get(page.id) or {}
    sections = [_summary(page, shape), _viewer(page), _stages(page, shape), _candidates(page, shape)]
    sections += [_numbers(page), _origin(page, shape)]
    links = [("../report.html", "Report of all shapes")]
    links += [(f"{i}.html", f"{word} {i}") for word, i in (("Previous:", page.before), ("Next:", page.after)) if i]
    return assemble(
        name=page.id,
        about=f"One shape of {page.record.get('name') or 'the cohort'}",
        version=str(page.record.get("ssmpipe_version", "")),
        sections=[section for section in sections if section is not None],
        kind="Patient page",
        links=links,
    )


def _warnings(shape: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [(s.get("stage", "?"), text) for s in shape.get("stages") or () for text in s.get("warnings") or ()]


def _summary(page: PatientPage, shape: Mapping[str, Any]) -> Section:
    failure = (page.record.get("failures") or {}).get(page.id)
    tiles = []
    k = page.index
    if failure:
        tiles.append(Tile("set aside", "in the model", f"at {failure.get('stage', '?')}", "bad"))
    elif k is None:
        tiles.append(Tile("no", "in the model", "not part of this run's model"))
    row = next((row for row in quality_rows(page.quality) if row.id == page.id), None)
    if row:
        rows = quality_rows(page.quality)
        usual = float(np.median([r.worse for r in rows]))
        remark = f"place {row.place} of {len(rows)}, 1 is worst; median of all {number(usual)}"
        tiles.append(Tile(f"{number(row.worse)} {page.unit}", "p99 to its reconstruction from the others", remark))
    entry = (page.certificate.get("shapes") or {}).get(page.id)
    if entry:
        status = str(entry.get("status", "undecided"))
        remark = f"area factor at least {number(entry.get('lower_bound'))}"
        tone = {"proved": "good", "refuted": "bad"}.get(status, "")
        if refuted_poles({page.id: entry}):
            remark, tone = f"inside of the domain; the surface may fold at a pole; {remark}", "bad"
        tiles.append(Tile(status, "one-to-one", remark, tone))
    if k is not None and page.model is not None and page.model.scores.size:
        scores = page.model.scores[k]
        largest = int(np.abs(scores).argmax())
        sign = "+" if scores[largest] > 0 else ""
        tiles.append(Tile(f"{sign}{number(float(scores[largest]))} σ", "largest score", f"mode {largest + 1}"))
    warnings = _warnings(shape)
    tiles.append(Tile(str(len(warnings)), "warnings" if len(warnings) != 1 else "warning"))
    html = fill("patient_summary.html.j2", failure=failure, tiles=tiles, warnings=warnings, file=shape.get("file", ""))
    return Section("summary", "Summary", html)


def _viewer(page: PatientPage) -> Section | None:
    c, model, k = page.correspondence, page.model, page.index
    if c is None or model is None or k is None:
        return None
    bare = replace(model, modes=model.modes[:0], variances=model.variances[:0], scores=np.zeros((0, 0)))
    flat = len(model.faces) == 0
    look = (-90.0, 89.0 if model.mean.shape[1] == 2 else 0.0) if flat else good_view(in_space(model.mean), model.faces)
    marks = landmark_places(c.points[k : k + 1], model.faces, model.topology, [page.landmarks])
    payload = viewer_payload(bare, look=look, unit=page.unit, landmarks=marks)
    payload |= {"colours": list(SIGNED_STOPS), "bone": BONE, "shapes": [quantized(c.points[k])], "maps": []}
    rebuilt = page.reconstructions
    if rebuilt is not None and page.id in list(rebuilt["ids"]):
        j = list(rebuilt["ids"]).index(page.id)
        payload["shapes"].append(quantized(rebuilt["points"][j]))
        payload["maps"].append(quantized_map("reconstruction", rebuilt["distance"][j]))
    html = fill(
        "patient_viewer.html.j2",
        payload=payload,
        looks=looks_from(*look),
        flat=flat,
        id=page.id,
        rebuilt=len(payload["maps"]) > 0,
        landmarks=marks,
    )
    return Section("shape", "The outline" if model.mean.shape[1] == 2 else "The shape in 3-D", html)


def _numbers(page: PatientPage) -> Section | None:
    rows = quality_rows(page.quality)
    row = next((row for row in rows if row.id == page.id), None)
    k, model, c = page.index, page.model, page.correspondence
    if row is None and k is None:
        return None
    blocks = []
    if row:
        for key, title in BLOCKS:
            if key in row.figures:
                usual = {word: float(np.median([r.figures[key][word] for r in rows])) for word in WORDS}
                blocks.append((title, row.figures[key], usual))
    scores, plot, grid = [], "", None
    if k is not None and model is not None and model.scores.size:
        scores = [float(x) for x in model.scores[k][:20]]
        plot = _score_plot(scores)
    if k is not None and c is not None and c.parameters.shape[2] == 2 and len(c.grid) == 2:
        nodes = grid_nodes(c.parameters[k], tuple(c.grid), c.topology)
        factors = area_factors(nodes)
        grid = {"picture": grid_picture(nodes, factors, 2.0), "low": float(factors.min()), "high": float(factors.max())}
    html = fill(
        "patient_numbers.html.j2",
        blocks=blocks,
        words=WORDS,
        unit=page.unit,
        size=row.size if row else None,
        scores=scores,
        plot=plot,
        grid=grid,
        certificate=_plain((page.certificate.get("shapes") or {}).get(page.id) or {}),
    )
    return Section("numbers", "Distances, scores, certificate", html)


def _plain(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Numbers and short texts of a certificate."""
    return {key: value for key, value in entry.items() if isinstance(value, (str, int, float, bool))}


def _score_plot(scores: Sequence[float]) -> str:
    with style():
        made = figure(5.2, 2.1)
        made.subplots_adjust(left=0.1, right=0.99, bottom=0.24, top=0.96)
        axes = made.subplots()
        axes.bar(np.arange(1, len(scores) + 1), scores, color=AFTER, width=0.65)
        axes.axhline(0, color="#66727f", linewidth=0.8)
        reach = max(3.0, 1.05 * float(np.abs(scores).max(initial=0.0)))
        axes.set(xlabel="mode", ylabel="σ", ylim=(-reach, reach), xticks=np.arange(1, len(scores) + 1))
        return svg_uri(made)


def _origin(page: PatientPage, shape: Mapping[str, Any]) -> Section:
    known = [step for step in page.steps if step.shape is not None]
    matrix = np.asarray(known[-1].transform) if known else np.eye(4)
    if page.index is not None and page.correspondence is not None:
        matrix = page.correspondence.transform[page.index]
    determinant = float(np.linalg.det(matrix[:3, :3]))
    html = fill(
        "patient_origin.html.j2",
        file=shape.get("file", ""),
        info={k: v for k, v in (shape.get("info") or {}).items() if v not in (None, "")},
        matrix=[[f"{x:.6g}".replace("-", "−") for x in line] for line in matrix.tolist()],
        mirrored=determinant < 0,
        factor=number(abs(determinant) ** (1 / 3), 6),
        in_model=page.index is not None,
        unit=page.unit,
    )
    return Section("origin", "Scan and transform", html)


# --- stages ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Change:
    """Before and after of one stage: pictures, the largest distance between them, and a sentence on how it was moved."""

    before: str = ""
    after: str = ""
    limit: str = ""
    moved: str = ""
    same: bool = False


def _stages(page: PatientPage, shape: Mapping[str, Any]) -> Section | None:
    states = {step.key: step for step in page.steps}
    last = next((step for step in reversed(page.steps) if step.shape is not None), None)
    previous = states.get("scan")
    rows = []
    failure = (page.record.get("failures") or {}).get(page.id) or {}
    stages = list(shape.get("stages") or ())
    if "optimize" in states:  # the last picture: the same points on every shape
        stages.append({"stage": "optimize", "folder": "optimize", "step": "corresponded surface", "status": "done"})
    for stage in stages:
        key = str(stage.get("folder") or stage.get("stage"))
        state = states.get(key)
        change = Change()
        if state is not None and state.shape is not None and last is not None:
            change = _change(previous, state, last.transform, page.unit)
        failed = failure.get("stage") in (stage.get("step"), stage.get("stage")) and stage.get("status") != "done"
        rows.append(
            {
                "title": stage.get("step") or stage.get("stage", "?"),
                "status": stage.get("status", ""),
                "metrics": {k: v for k, v in (stage.get("metrics") or {}).items() if not _long(v)},
                "warnings": stage.get("warnings") or [],
                "failure": failure if failed else None,
                "change": change,
            }
        )
        if state is not None and state.shape is not None:
            previous = state
    if not rows:
        return None
    ramp = png_uri((255 * CHANGE(np.tile(np.linspace(0, 1, 240), (12, 1)))[..., :3]).round().astype(np.uint8))
    return Section("stages", "Stage by stage", fill("patient_stages.html.j2", rows=rows, unit=page.unit, ramp=ramp))


def _candidates(page: PatientPage, shape: Mapping[str, Any]) -> Section | None:
    """Show every place that geometry proposes on the scan, from the side where it lies."""
    found = candidates_of(shape)
    if not found:
        return None
    scan = next((step for step in page.steps if step.key == "scan"), None)
    marks = []
    for name, place in found.items():
        drawn = ""
        if scan is not None and scan.shape is not None and scan.shape.cells.shape[1] == 3:
            in_file = np.array([[float(x) for x in place.split()]])
            drawn = _draw_mark(scan.shape, apply(np.asarray(scan.transform), in_file)[0])
        marks.append({"name": name, "place": place, "picture": drawn})
    html = fill("patient_candidates.html.j2", marks=marks)
    return Section("candidates", "Landmarks that geometry proposes", html)


def _draw_mark(scan: Geometry, place: Floats) -> str:
    """Draw the scan from where a place on it is seen, the place as a red spot with a dark rim."""
    small = _small(scan, scan.diagonal / _CELLS)
    apart = np.linalg.norm(small.points - place, axis=1) / scan.diagonal
    towards = vertex_normals(small.points, small.cells)[apart < _SPOT].sum(axis=0)
    if not towards.any():
        towards = place - small.points.mean(axis=0)
    view = (
        float(np.degrees(np.arctan2(towards[1], towards[0]))),
        float(np.degrees(np.arctan2(towards[2], np.hypot(*towards[:2])))),
    )
    colours = np.tile(to_rgb(BONE), (len(small.points), 1))
    colours[apart < _SPOT] = to_rgb(CHANGE_STOPS[3])
    colours[apart < 0.6 * _SPOT] = to_rgb(CHANGE_STOPS[2])
    stand = _Stand.of(small, view=view)
    shot = picture(
        small.points, small.cells, view=stand.view, centre=stand.centre, radius=stand.radius,
        colours=colours, inches=_INCHES, dpi=_DPI, finer=1.5,
    )  # fmt: skip
    return png_uri(shot, 96)


def _long(value: Any) -> bool:
    return isinstance(value, Mapping) or (isinstance(value, (list, tuple)) and len(value) > 6)


def _change(previous: StepShape | None, state: StepShape, frame: Floats, unit: str) -> Change:
    """Draw both in the frame of the last step, coloured by their distance from each other."""
    assert state.shape is not None
    after = state.shape.moved(frame @ np.linalg.inv(state.transform))
    if previous is None or previous.shape is None:
        drawn = after if state.pattern is not None else _small(after, after.diagonal / _CELLS)
        return Change(after=_draw(_Stand.of(after), drawn, None, state.pattern))
    before = previous.shape.moved(frame @ np.linalg.inv(previous.transform))
    moved = _motion(state.transform @ np.linalg.inv(previous.transform), before, unit)
    cell, least = before.diagonal / _CELLS, SAME * before.diagonal
    small = [_small(g, cell) for g in (before, after)]
    stand = _Stand.of(before, small[0])
    apart = [_distances(g.points, other, least) for g, other in zip(small, (after, before), strict=True)]
    everything = np.concatenate(apart)
    if float(everything.max()) <= least:
        drawn = after if state.pattern is not None else small[1]
        return Change(after=_draw(stand, drawn, None, state.pattern), moved=moved, same=True)
    limit = nice_ceiling(float(np.quantile(everything, 0.995)))
    first = _draw(stand, small[0], apart[0] / limit, None)
    if state.pattern is not None:
        return Change(first, _draw(stand, after, None, state.pattern), f"{limit:g}", moved)
    return Change(first, _draw(stand, small[1], apart[1] / limit, None), f"{limit:g}", moved)


def _distances(places: Floats, shape: Geometry, least: float) -> Floats:
    """Return the distance of places to a shape; zero where one of its points lies within ``least``, which is found much faster.

    Examples
    --------
    >>> flat = Geometry(np.array([[0, 0, 0], [9, 0, 0], [0, 9, 0.0]]), np.array([[0, 1, 2]]))
    >>> _distances(np.array([[9.0, 0, 0], [1, 1, 2]]), flat, 1e-9)
    array([0., 2.])
    """
    apart = np.zeros(len(places))
    if least > 0:
        alone = np.flatnonzero(np.isinf(cKDTree(shape.points).query(places, distance_upper_bound=least)[0]))
    else:
        alone = np.arange(len(places))
    if len(alone):
        apart[alone] = locate(places[alone], shape.points, shape.cells)[0]
    return apart


def _small(shape: Geometry, cell: float) -> Geometry:
    if shape.cells.shape[1] != 3 or len(shape.points) < _ENOUGH:
        return shape
    kept, faces = thinned(shape.points, shape.cells, cell)
    return Geometry(shape.points[kept], faces) if len(faces) else shape


@dataclass(frozen=True, eq=False)
class _Stand:
    """From where pictures are taken, so that several show a shape and what became of it in one scale."""

    frame: Geometry
    view: tuple[float, float]
    centre: Floats
    radius: float

    @classmethod
    def of(cls, frame: Geometry, small: Geometry | None = None, view: tuple[float, float] | None = None) -> _Stand:
        """Look at ``frame`` from ``view``, or so that much is seen; ``small``: the same with fewer triangles."""
        if frame.cells.shape[1] != 3:
            return cls(frame, (0.0, 0.0), np.zeros(2), 1.0)
        look = small or frame
        view = view or good_view(look.points, look.cells)
        axes = view_axes(*view)[:2]
        flat = frame.points @ axes.T
        low, high = flat.min(axis=0), flat.max(axis=0)
        return cls(frame, view, (low + high) / 2 @ axes, 0.53 * float((high - low).max()))


def _motion(matrix: Floats, shape: Geometry, unit: str) -> str:
    """Say in words how a step moved the shape.

    Examples
    --------
    >>> turn = np.array([[0, -1.0, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    >>> _motion(turn, Geometry(np.eye(3), np.array([[0, 1, 2]])), "mm")
    'Moved: turned by 90.0°.'
    """
    if np.allclose(matrix, np.eye(4), atol=1e-9):
        return ""
    linear = matrix[:3, :3]
    determinant = float(np.linalg.det(linear))
    factor = abs(determinant) ** (1 / 3)
    said = []
    turn = linear / factor
    if determinant < 0:
        said.append("mirrored to the other side")
        turn = turn @ np.diag([-1.0, 1.0, 1.0])
    angle = float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
    if angle > 0.05 and determinant > 0:
        said.append(f"turned by {angle:.1f}°")
    if abs(factor - 1) > 1e-6:
        said.append(f"scaled by {factor:.4g}")
    shift = float(np.linalg.norm(matrix[:3, 3]))
    if shift > SAME * shape.diagonal:
        said.append(f"shifted by {number(shift)} {unit} (of the origin)")
    return f"Moved: {', '.join(said)}." if said else ""


def _draw(stand: _Stand, shape: Geometry, share: Floats | None, pattern: Any) -> str:
    """Draw ``shape``; ``share`` in [0, 1] colours its points."""
    if shape.cells.shape[1] != 3:
        return _draw_curve(stand.frame, shape)
    colours = np.tile(to_rgb(BONE), (len(shape.points), 1)) if share is None else CHANGE(np.clip(share, 0, 1))[:, :3]
    if pattern is not None and len(pattern) == len(colours):
        colours = np.where(np.asarray(pattern)[:, None], colours * 0.62, colours)
    shot = picture(
        shape.points, shape.cells, view=stand.view, centre=stand.centre, radius=stand.radius,
        colours=colours, inches=_INCHES, dpi=_DPI, finer=1.5,
    )  # fmt: skip
    return png_uri(shot, 96)


def _draw_curve(frame: Geometry, shape: Geometry) -> str:
    with style():
        made = figure(_INCHES, _INCHES)
        panel = made.add_axes((0.03, 0.03, 0.94, 0.94))
        panel.set_axis_off()
        for geometry, colour, width in ((frame, BEFORE, 1.0), (shape, AFTER, 1.4)):
            ends = geometry.points[geometry.cells]
            # pairs of points with a gap after each
            line = np.concatenate([ends, np.full_like(ends[:, :1], np.nan)], axis=1).reshape(-1, ends.shape[2])
            panel.plot(line[:, 0], line[:, 1], color=colour, linewidth=width)
        panel.set_aspect("equal")
        return png_uri(pixels(made, 2 * _DPI), 32)


def checkers(uv: Floats, n: int = 10) -> np.ndarray:
    """Return which points lie on the dark squares of an ``n`` x ``n`` checkerboard of the parameters.

    Examples
    --------
    >>> checkers(np.array([[0.05, 0.05], [0.15, 0.05]]))
    array([False,  True])
    """
    return np.asarray(np.floor(n * np.asarray(uv)[:, :2] + 1e-9).astype(int).sum(axis=1) % 2 == 1)


def corresponded_state(c: Correspondence, k: int) -> StepShape:
    """Return the corresponded surface of shape ``k`` with a checkerboard of the grid of points."""
    cells = c.faces if len(c.faces) else edge_indices(c.points.shape[1], c.topology == "curve-closed")
    pattern = None
    if len(c.grid) == 2:
        rows, columns = np.meshgrid(*(np.arange(n) / max(n - 1, 1) for n in c.grid), indexing="ij")
        pattern = checkers(np.stack([rows.ravel(), columns.ravel()], axis=1) * 0.999)
    return StepShape("optimize", Geometry(c.points[k], cells), c.transform[k], pattern)
