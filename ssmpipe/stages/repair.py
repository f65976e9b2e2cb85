"""Clean a raw surface: one oriented component without handles."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, Literal

from pydantic import Field

from ssmpipe.contract import Context, Port, Stage, StageConfig
from ssmpipe.core.mesh.operators import area, volume
from ssmpipe.core.mesh.topology import boundary_loops, genus
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.cleaning import Cleaned, check_handles, check_openings, clean
from ssmpipe.core.repair.flat_faces import flat_faces
from ssmpipe.core.repair.handles import cut_handles
from ssmpipe.core.repair.intersections import crossings, intersecting_pairs, repair_intersections
from ssmpipe.core.repair.spikes import Spike, find_spikes, remove_spikes


class Config(StageConfig):
    """Options of repair."""

    components: Annotated[
        Literal["one", "largest"],
        Field(
            description="What to do when several components are larger than debris: refuse the scan, or keep the largest."
        ),
    ] = "one"
    debris_fraction: Annotated[
        float,
        Field(ge=0, lt=0.5, description="A component with less than this share of the area is dropped as debris [-]."),
    ] = 0.02
    merge_tolerance: Annotated[
        float,
        Field(
            ge=0,
            lt=0.01,
            description="Vertices nearer than this share of the bounding box's diagonal are one; raise it for files whose faces do not "
            "quite meet [-].",
        ),
    ] = 1e-7
    max_handle_mm: Annotated[
        float | None,
        Field(
            gt=0,
            description="Handles with a loop no longer than this, bridges and tunnels, are cut and closed; by default every handle is "
            "refused with its place [mm].",
        ),
    ] = None
    spike_width: Annotated[
        float,
        Field(
            ge=0,
            description="Needles that stand out of the surface are removed when they are narrower than this many median edges of the mesh "
            "and at least 1.5 times longer than wide; 0 keeps them [-].",
        ),
    ] = 4.0
    self_intersections: Annotated[
        Literal["repair", "report", "ignore"],
        Field(
            description="Where the surface passes through itself: replace the faces there by smooth patches, only warn with the places, or "
            "do not look."
        ),
    ] = "repair"
    max_openings: Annotated[int, Field(ge=0, description="Number of boundary loops that a scan may have [count].")] = 1


def run(mesh: TriMesh, *, cfg: Config, ctx: Context) -> dict[str, Any]:
    """Repair one scan; see :func:`ssmpipe.core.repair.cleaning.clean`."""
    cleaned = clean(
        mesh,
        debris_fraction=cfg.debris_fraction,
        components=cfg.components,
        merge_tolerance=cfg.merge_tolerance,
    )
    result = cleaned.mesh
    check_openings(result, cfg.max_openings)
    if cfg.max_handle_mm is not None:
        result, handles = cut_handles(result, cfg.max_handle_mm)
        ctx.metric("handles_cut", len(handles))
        ctx.metric("handle_places_mm", [[round(c, 2) for c in cut.place] for cut in handles])
        for cut in handles:
            x, y, z = cut.place
            ctx.warn(
                f"a handle with a loop of {cut.length:.1f} mm at ({x:.1f}, {y:.1f}, {z:.1f}) mm was cut and closed, all within "
                f"{cut.reach:.1f} mm of the loop was replaced; look at the place"
            )
    check_handles(result)
    result = _without_spikes(result, cfg, ctx)
    result = _without_intersections(result, cfg, ctx)
    for name, count in cleaned.changes.items():
        ctx.metric(name, count)
    ctx.metric("dropped_area_percent", 100.0 * cleaned.dropped_area_fraction)
    ctx.metric("n_vertices", result.n_vertices)
    ctx.metric("n_faces", result.n_faces)
    ctx.metric("genus", genus(result.faces))
    ctx.metric("n_loops", len(boundary_loops(result.faces)))
    ctx.metric("area_mm2", area(result))
    ctx.metric("volume_mm3", volume(result))
    _warn_of_flat_faces(cleaned, ctx)
    dropped = cleaned.changes["dropped_components"]
    if cleaned.dropped_area_fraction >= cfg.debris_fraction:
        ctx.warn(
            f"{dropped} components with {100 * cleaned.dropped_area_fraction:.1f} % of the area were dropped; look at the scan "
            "if that is more than expected"
        )
    elif dropped:
        ctx.log.info("%d small components dropped (%.2f %% of the area)", dropped, 100 * cleaned.dropped_area_fraction)
    return {"mesh": result}


def _warn_of_flat_faces(cleaned: Cleaned, ctx: Context) -> None:
    n_left = cleaned.changes["flat_faces_left"]
    if n_left == 0:
        return
    mesh = cleaned.mesh
    middles = mesh.vertices[mesh.faces[flat_faces(mesh)]].mean(axis=1)
    places = ", ".join(f"({_place(middle)}) mm" for middle in middles[:4]) + (", ..." if len(middles) > 4 else "")
    ctx.warn(
        f"{n_left} faces without area could not be removed: {places}; the surface is folded or pinched there, repair the segmentation"
    )


def _without_spikes(mesh: TriMesh, cfg: Config, ctx: Context) -> TriMesh:
    if cfg.spike_width == 0:
        return mesh
    spikes = find_spikes(mesh, max_width=cfg.spike_width)
    result, removed = remove_spikes(mesh, spikes)
    ctx.metric("spikes_removed", len(removed))
    ctx.metric("spikes_mm", [[*(round(c, 2) for c in s.place), round(s.length, 2), round(s.width, 2)] for s in removed])
    if removed:
        ctx.warn(
            f"{len(removed)} spikes were removed: {_list(removed)}; look at the places, or keep them with repair.spike_width: 0"
        )
    kept = [spike for spike in spikes if spike not in removed]
    if kept:
        ctx.warn(f"{len(kept)} spikes could not be removed: {_list(kept)}; repair the segmentation there")
    return result


def _list(spikes: list[Spike]) -> str:
    text = [f"{s.length:.1f} mm long, {s.width:.1f} mm wide at ({_place(s.place)}) mm" for s in spikes]
    return ", ".join(text[:4]) + (", ..." if len(text) > 4 else "")


def _place(place: Iterable[float]) -> str:
    return ", ".join(f"{c:.1f}" for c in place)


def _without_intersections(mesh: TriMesh, cfg: Config, ctx: Context) -> TriMesh:
    if cfg.self_intersections == "ignore":
        return mesh
    found = crossings(mesh, intersecting_pairs(mesh))
    left, result = found, mesh
    if found and cfg.self_intersections == "repair":
        result = repair_intersections(mesh)
        left = crossings(result, intersecting_pairs(result))
    ctx.metric("self_intersections", len(found))
    ctx.metric("self_intersections_mm", [[round(c, 2) for c in crossing.place] for crossing in found])
    ctx.metric("self_intersections_left", len(left))
    if len(left) < len(found):
        ctx.log.info("%d of %d places where the surface met itself were replaced", len(found) - len(left), len(found))
    if left:
        places = ", ".join(f"({_place(c.place)}) mm ({c.n_faces} faces)" for c in left[:4]) + (
            ", ..." if len(left) > 4 else ""
        )
        ctx.warn(f"the surface passes through itself in {len(left)} places: {places}; repair the segmentation there")
    return result


STAGE = Stage(
    name="repair",
    scope="shape",
    version=3,  # faces without area are removed
    config=Config,
    run=run,
    inputs=(Port("mesh", "trimesh"),),
    outputs=(Port("mesh", "trimesh"),),
    methods="Raw surfaces were cleaned of duplicate vertices, degenerate and duplicate faces, faces without area, non-manifold fins and "
    "debris, and oriented outward; needles narrower than {spike_width} edges were removed (0: none), and self-intersections treated by: "
    "{self_intersections}.",
)
