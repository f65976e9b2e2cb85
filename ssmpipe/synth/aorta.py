"""Ascending aortas with known correspondence: the lumen with three sinuses, made to look like raw segmentations.

A point of the wall has two material parameters: the angle ``theta`` (left sinus at 0, right at 120, non-coronary at 240 degrees)
and the height ``t``, 0 at the annulus and 56 at the upper end of what is modelled [mm in the mean shape]. Shape ``i`` puts it at

    bend_i( R_i(theta, t) (cos a_i(theta), sin a_i(theta)), z_i(t) )

with a radius, an angle, a height and a bend of its own. The same parameters name the same place in every shape, so the true
correspondence is exact. Angles and heights slide *along* the wall: arc length does not tell which points belong together.

The scans have what real ones have (Li 2015, section 4.2): coronary stumps cut at different lengths, missing pieces, ragged
lower rims, one that ends too early below the sinuses, one with a flat closed top, the steps of the voxels, and noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import igl
import numpy as np

from ssmpipe.core.arrays import Bools, Floats, Ints
from ssmpipe.core.errors import ConfigError
from ssmpipe.synth._scans import (
    apply,
    grain,
    rounded,
    scanner_pose,
    shuffled,
    spread_scores,
    without,
    write_json,
    write_scan,
)
from ssmpipe.synth.implicit import Field, field_gradient, polygonize, round_cone, smooth_union

MODES = {
    "diameter": "all radii, 7 % per unit",
    "sinus_size": "all three sinuses bulge 2 mm more per unit",
    "left_sinus": "the left sinus bulges 0.6 mm more, the other two 0.3 mm less per unit",
    "length": "the tube, 1.2 % longer per unit",
    "sinus_height": "the sinutubular junction moves up the wall by 1 mm per unit; both ends stay",
    "sinus_turn": "the commissure between left and right sinus moves around the wall by 2.5 degrees per unit",
    "bend": "curvature of the centre line above the root, 7 % per unit",
}
"""Known modes and what one unit of their score does; the first two are the largest."""

SIZES = np.array([1.0, 0.6, 0.25, 0.25, 0.25, 0.25, 0.15])
"""About how far a point moves for one unit of each score [mm]."""

SINUSES = {"left": 0.0, "right": 2 * np.pi / 3, "non": 4 * np.pi / 3}
"""Material angle of the middle of each sinus."""

LANDMARKS = (
    *("nadir_left", "nadir_right", "nadir_non"),
    *("commissure_left_right", "commissure_right_non", "commissure_non_left"),
    *("ostium_left", "ostium_right", "opening_bottom", "opening_top"),
)
"""Lowest point of each sinus, top of the groove between two, middle of each coronary ostium on the wall without stump, and
the centre line at both ends of what is modelled."""

HEIGHT = 56.0
"""Material height of the upper end of what is modelled [mm]; the lower one is at 0."""

NADIR, COMMISSURE, OSTIUM = 4.0, 21.0, 17.0
"""Material heights of the landmarks [mm]."""

COVERED = 0.5
"""The scan covers a true point when it passes by within this distance [mm]."""

N_ANGLES, N_HEIGHTS = 96, 60
_STRAIGHT, _CURVATURE = 20.0, 1 / 75.0
_LOWER, _UPPER = np.array([-36.0, -36.0, -16.0]), np.array([42.0, 36.0, 82.0])


@dataclass(frozen=True)
class Wall:
    """The wall of one aorta without stumps, in its own frame: z up the centre line from the annulus, bent towards x.

    Parameters
    ----------
    scores : (n_modes,) float64
        In the order of :data:`MODES`.
    weights : (2, 4, 5) float64
        Small radial waves of its own [mm]: cosine and sine, four waves around, five bumps along.
    """

    scores: Floats
    weights: Floats

    def angle(self, theta: Floats) -> Floats:
        """Return the angle at which material angles lie [rad]."""
        return theta + np.deg2rad(2.5) * self.scores[5] * np.cos(theta - np.pi / 3)

    def height(self, t: Floats) -> Floats:
        """Return the height along the centre line at which material heights lie [mm]."""
        slide = np.exp(-0.5 * ((t - 23.0) / 9.0) ** 2)
        return (1 + 0.012 * self.scores[3]) * (t + self.scores[4] * slide)

    def radius(self, theta: Floats, t: Floats) -> Floats:
        """Return the distance of the wall from the centre line [mm]."""
        base = 13.3 + 2.2 / (1 + np.exp(-(t - 30.0) / 5.0)) - 0.9 * np.exp(-0.5 * (t / 6.0) ** 2)
        size = 5.6 + 2.0 * self.scores[1] + self.scores[2] * np.array([0.6, -0.3, -0.3])
        along = (t - 12.5) / 8.0
        bell = np.exp(-0.5 * along**2 - 0.35 * along**4)
        for middle, bulge in zip(SINUSES.values(), size, strict=True):
            base = base + bulge * bell * np.exp(3.6 * (np.cos(theta - middle) - 1))
        bumps = np.exp(-0.5 * ((np.asarray(t)[..., None] - np.linspace(0, HEIGHT, 5)) / 10.0) ** 2)
        around = np.asarray(theta)[..., None] * np.arange(4)
        waves = np.stack([np.cos(around), np.sin(around)])
        own = np.einsum("k...m,kmb,...b->...", waves, self.weights, bumps)
        return np.asarray((1 + 0.07 * self.scores[0]) * base + own)

    def point(self, theta: Floats | float, t: Floats | float, share: float = 1.0) -> Floats:
        """Return the (..., 3) points of the wall, or at a ``share`` of the way from the centre line to it [mm]."""
        theta, t = np.asarray(theta), np.asarray(t)
        radius, angle = share * self.radius(theta, t), self.angle(theta)
        straight = np.stack([radius * np.cos(angle), radius * np.sin(angle), self.height(t)], axis=-1)
        return self._bend(straight)

    def material(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the material angle, the material height and the distance from the centre line of (n, 3) points."""
        x, y, z = self._unbend(points).T
        theta = np.linspace(-2 * np.pi, 2 * np.pi, 4097)
        t = np.linspace(-40.0, 120.0, 4097)
        return (
            np.interp(np.arctan2(y, x), self.angle(theta), theta),
            np.interp(z, self.height(t), t),
            np.hypot(x, y),
        )

    def field(self, points: Floats) -> Floats:
        """Return about the distance to the wall at (n, 3) points, negative inside [mm]."""
        theta, t, distance = self.material(points)
        return distance - self.radius(theta, t)

    @property
    def _curvature(self) -> float:
        return float(_CURVATURE * (1 + 0.07 * self.scores[6]))

    def _bend(self, straight: Floats) -> Floats:
        x, y, z = np.moveaxis(straight, -1, 0)
        turn = self._curvature * np.maximum(z - _STRAIGHT, 0.0)
        lever = 1 / self._curvature - x
        up = np.minimum(z, _STRAIGHT) + lever * np.sin(turn)
        return np.stack([1 / self._curvature - lever * np.cos(turn), y, up], axis=-1)

    def _unbend(self, bent: Floats) -> Floats:
        x, y, z = bent.T
        side, up = 1 / self._curvature - x, np.maximum(z - _STRAIGHT, 0.0)
        turn = np.arctan2(up, np.maximum(side, 1e-9))
        return np.column_stack(
            [1 / self._curvature - np.hypot(side, up), y, np.minimum(z, _STRAIGHT) + turn / self._curvature]
        )


@dataclass(frozen=True)
class Stump:
    """A coronary artery that is cut off: two round cones and the plane of the cut, in the frame of the shape [mm]."""

    points: Floats
    radius: float
    cut: Floats

    def field(self, points: Floats) -> Floats:
        """Return about the distance to the artery, which goes on beyond the cut; negative inside."""
        root, elbow, end = (tuple(p) for p in self.points)
        first = round_cone(points, root, elbow, (self.radius, self.radius))
        return smooth_union(first, round_cone(points, elbow, end, (self.radius, 0.85 * self.radius)), 0.5)

    def beyond(self, points: Floats) -> Bools:
        """Tell which points on the artery lie beyond the cut."""
        along = (self.points[2] - self.points[1]) / np.linalg.norm(self.points[2] - self.points[1])
        return np.asarray(((points - self.cut) @ along > 0) & (self.field(points) < 1.0))


def make_stump(wall: Wall, side: str, length: float, rng: np.random.Generator) -> Stump:
    """Return the artery from the left or the right sinus, cut ``length`` [mm] outside of the wall."""
    theta, t = SINUSES[side] + rng.normal(scale=0.06), OSTIUM
    foot = wall.point(theta, t)
    out = foot - wall.point(theta, t, 0.5)
    out /= np.linalg.norm(out)
    around = np.cross([0.0, 0.0, 1.0], out)
    along = out + (0.9 if side == "left" else -0.9) * around + rng.normal(scale=0.15, size=3)
    along /= np.linalg.norm(along)
    first = min(length, 4.0)
    elbow = foot + first * out
    cut = elbow + max(length - first, 0.5) * along
    return Stump(np.stack([foot - 3.0 * out, elbow, cut + 6.0 * along]), rng.uniform(1.7, 2.3), cut)


@dataclass(frozen=True)
class Flaws:
    """What is wrong with one scan.

    Parameters
    ----------
    bottom, top : float
        Material heights where the scan ends [mm].
    closed_top : bool
    stumps : dict of str to float
        Length of the coronary arteries that are left [mm].
    holes : list of (theta, t, radius)
        Missing pieces of the wall.
    """

    bottom: float
    top: float
    closed_top: bool
    stumps: dict[str, float]
    holes: list[tuple[float, float, float]]


def draw_flaws(index: int, n: int, rng: np.random.Generator) -> Flaws:
    """Return the flaws of shape ``index`` of ``n``.

    The first has a closed top, the third too little below the sinuses; every second and the first have one missing piece or
    two, on the non-coronary side or on the tube, away from the stumps.
    """
    lengths = np.linspace(2.0, 14.0, n)
    places = [
        (SINUSES["non"] + rng.uniform(-0.5, 0.5), rng.uniform(9.0, 18.0), rng.uniform(2.5, 4.5)),
        (rng.uniform(0, 2 * np.pi), rng.uniform(36.0, 48.0), rng.uniform(3.0, 5.5)),
    ]
    return Flaws(
        bottom=2.0 if index == 2 else rng.uniform(-8.0, -4.0),
        top=rng.uniform(59.0, 65.0),
        closed_top=index == 0,
        stumps={"left": float(lengths[(3 * index + 1) % n]), "right": float(lengths[(5 * index + 4) % n])},
        holes=[places, places[1:], [], places[:1]][index % 4],
    )


def raw_scan(wall: Wall, flaws: Flaws, pose: Floats, rng: np.random.Generator, spacing: float) -> tuple[Floats, Ints]:
    """Return the surface of one scan in the frame of the shape.

    Marching cubes on the scanner's voxels with half of the grey levels lost, which leaves steps; noise of 0.1 mm.

    Returns
    -------
    vertices : (n, 3) float64
    faces : (m, 3) int64
        Outward, manifold, in one piece, in random order.
    """
    stumps = [make_stump(wall, side, length, rng) for side, length in flaws.stumps.items()]
    lid = rng.normal(scale=0.03, size=2)

    def body(points: Floats) -> Floats:
        theta, t, distance = wall.material(points)
        tilted = t + distance * (lid[0] * np.cos(theta) + lid[1] * np.sin(theta))
        tube = distance - wall.radius(theta, t)
        for stump in stumps:
            tube = smooth_union(tube, stump.field(points), 2.0)
        top = flaws.top + (0.0 if flaws.closed_top else 6.0)
        return np.maximum(tube, np.maximum(tilted - top, -14.0 - t))

    def voxels(points: Floats) -> Floats:
        values, step = body(points), 0.5 * spacing
        return 0.5 * (values + step * (np.floor(values / step) + 0.5))

    vertices, faces = _surface(voxels, pose, spacing)
    normals = field_gradient(body, vertices)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    theta, t, distance = wall.material(vertices)
    around = 13.0 * np.column_stack([np.cos(theta), np.sin(theta), np.zeros(len(theta))])
    ragged = 0.8 * np.cos(theta * 2 + rng.uniform(0, 6)) + grain(around, rng, rms=0.7, length=1.2)
    removed = t < flaws.bottom + (0.3 if flaws.bottom > 0 else 1.0) * ragged
    if not flaws.closed_top:
        removed |= t + distance * (lid[0] * np.cos(theta) + lid[1] * np.sin(theta)) > flaws.top
    for stump in stumps:
        removed |= stump.beyond(vertices)
    for angle, height, radius in flaws.holes:
        offset = vertices - wall.point(angle, height)
        apart = np.linalg.norm(offset, axis=1)
        wavy = grain(offset / np.maximum(apart, 1e-9)[:, None], rng, rms=0.12, length=0.4)
        removed |= apart < radius * (1 + wavy)
    vertices = vertices + normals * grain(vertices, rng, rms=0.1, length=1.5)[:, None]
    return shuffled(*without(vertices, faces, removed), rng)


def _surface(field: Field, pose: Floats, spacing: float) -> tuple[Floats, Ints]:
    turn = np.eye(4)
    turn[:3, :3] = np.linalg.inv(pose[:3, :3])
    return polygonize(field, _LOWER, _UPPER, spacing, turn)


def truth_grid() -> tuple[Floats, Ints]:
    """Return the parameters of the true points and the triangles that join them.

    Returns
    -------
    parameters : (N_ANGLES * N_HEIGHTS, 2) float64
        Share of the turn in [0, 1) and of the height in [0, 1], the second one fastest.
    faces : (2 * N_ANGLES * (N_HEIGHTS - 1), 3) int64
        Outward; the last column of points is joined to the first.
    """
    u, v = np.meshgrid(np.arange(N_ANGLES) / N_ANGLES, np.linspace(0, 1, N_HEIGHTS), indexing="ij")
    i, j = np.meshgrid(np.arange(N_ANGLES), np.arange(N_HEIGHTS - 1), indexing="ij")
    a, b = i * N_HEIGHTS + j, (i + 1) % N_ANGLES * N_HEIGHTS + j
    faces = np.stack([np.stack([a, b, b + 1], axis=-1), np.stack([a, b + 1, a + 1], axis=-1)], axis=2)
    return np.column_stack([u.ravel(), v.ravel()]), faces.reshape(-1, 3)


def landmark_points(wall: Wall) -> dict[str, Floats]:
    """Return the true landmarks of a shape in its own frame."""
    middles = list(SINUSES.values())
    grooves = [m + np.pi / 3 for m in middles]
    found = [wall.point(m, NADIR) for m in middles]
    found += [wall.point(g, COMMISSURE) for g in grooves]
    found += [wall.point(SINUSES[side], OSTIUM) for side in ("left", "right")]
    found += [wall.point(0.0, t, 0.0) for t in (0.0, HEIGHT)]
    return dict(zip(LANDMARKS, found, strict=True))


def write_cohort(out_dir: Path, n: int = 8, seed: int = 0, spacing: float = 0.7) -> None:
    """Write a cohort of raw-looking scans and the truth about them; the same seed gives the same bytes.

    Parameters
    ----------
    out_dir : Path
        Gets ``scans/<id>.ply``, ``cohort.csv`` (id, subject), ``landmarks.json``, ``truth.npz`` and ``truth.json``. In
        ``truth.npz``: ``points`` (n, n_T, 3) of the wall without stumps, holes and noise, in scan coordinates;
        ``covered`` (n, n_T) tells which of them the scan really shows; ``parameters`` (n_T, 2) share of the turn and of the height;
        ``grid`` (2,); ``faces`` (n_F, 3), outward; ``pose`` (n, 4, 4) from the frame of the shape to the scan;
        ``scores`` (n, n_modes); ``mode_names``; ``landmark_names`` and ``landmarks`` (n, n_L, 3).
    n : int
        Number of shapes, at least 3.
    seed : int
    spacing : float
        Size of the voxels [mm]: 0.7 gives about 40,000 faces, 1.1 about 16,000.

    Raises
    ------
    ConfigError
        If there are fewer than 3 shapes.
    """
    if n < 3:
        raise ConfigError(f"a cohort of aortas needs at least 3 shapes, got {n}", "raise --n")
    scans = Path(out_dir) / "scans"
    scans.mkdir(parents=True, exist_ok=True)
    scores = spread_scores(n, len(MODES), np.random.default_rng([seed, 0]), n_draws=3000, sizes=SIZES)
    parameters, faces = truth_grid()
    theta, t = 2 * np.pi * parameters[:, 0], HEIGHT * parameters[:, 1]
    ids = [f"aorta_{i + 1:02d}" for i in range(n)]
    points, covered, poses, marks, flaws = [], [], [], [], []
    for i, shape_id in enumerate(ids):
        rng = np.random.default_rng([seed, i + 1])
        wall = Wall(scores[i], 0.1 * rng.normal(size=(2, 4, 5)))
        pose = scanner_pose(rng)
        flaws.append(draw_flaws(i, n, rng))
        vertices, triangles = raw_scan(wall, flaws[-1], pose, rng, spacing)
        write_scan(scans / f"{shape_id}.ply", apply(pose, vertices), triangles)
        truth = wall.point(theta, t)
        covered.append(igl.point_mesh_squared_distance(truth, vertices, triangles)[0] < COVERED**2)
        points.append(apply(pose, truth))
        poses.append(pose)
        marks.append(apply(pose, np.stack(list(landmark_points(wall).values()))))
    arrays = {
        "ids": np.array(ids),
        "points": np.array(points),
        "covered": np.array(covered),
        "parameters": parameters,
        "grid": np.array([N_ANGLES, N_HEIGHTS]),
        "faces": faces,
        "pose": np.array(poses),
        "scores": scores,
        "mode_names": np.array(list(MODES)),
        "landmark_names": np.array(LANDMARKS),
        "landmarks": np.array(marks),
    }
    np.savez(Path(out_dir) / "truth.npz", **arrays)  # type: ignore[arg-type]
    rows = ["id,subject", *(f"{shape_id},subject_{i + 1:02d}" for i, shape_id in enumerate(ids))]
    (Path(out_dir) / "cohort.csv").write_text("\n".join(rows) + "\n", encoding="utf-8", newline="\n")
    named = {
        shape_id: {name: rounded(p) for name, p in zip(LANDMARKS, rows_of, strict=True)}
        for shape_id, rows_of in zip(ids, marks, strict=True)
    }
    write_json(Path(out_dir) / "landmarks.json", named)
    write_json(
        Path(out_dir) / "truth.json",
        {
            "seed": seed,
            "units": "mm",
            "frame": "z up the centre line from the annulus, the tube bends towards x; left sinus at angle 0",
            "modelled": {"material_height_mm": [0.0, HEIGHT], "straight_up_to_mm": _STRAIGHT},
            "modes": MODES,
            "noise_rms_mm": 0.1,
            "voxel_mm": spacing,
            "covered_within_mm": COVERED,
            "flaws": {
                shape_id: {
                    "bottom": round(flaw.bottom, 3),
                    "top": round(flaw.top, 3),
                    "closed_top": flaw.closed_top,
                    "stumps": flaw.stumps,
                    "holes": [dict(zip(("theta", "t", "radius"), hole, strict=True)) for hole in flaw.holes],
                }
                for shape_id, flaw in zip(ids, flaws, strict=True)
            },
            "scores": {
                shape_id: dict(zip(MODES, row, strict=True)) for shape_id, row in zip(ids, scores.tolist(), strict=True)
            },
        },
    )
