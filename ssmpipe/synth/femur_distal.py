"""Distal femora with known correspondence: one template, moved by known smooth maps, made to look like raw scans.

The template is an implicit body (Ricci, 1973; blends after Quilez) in the frame of a right femur: x lateral, y anterior,
z proximal along the shaft, origin between the condyles at their distal end [mm]. Shape ``i`` is ``T_i`` of the template,

    T_i(x) = s_i (x + sum_k a_ik d_k(x) + e_i(x)),      s_i = 1 + 0.05 a_i,size

with fields ``d_k`` that are the same for all and a small smooth field ``e_i`` of its own. Hence the true correspondence
is exact: a template point and its images. The fields widen the condyles and the notch, lengthen the posterior condyles
while the shaft tilts, and slide epicondyles and groove *along* the surface: arc length then no longer tells which points
belong together, which is what correspondence methods are tested with.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.synth._scans import (
    apply,
    roughened,
    scanner_pose,
    specks,
    spread_scores,
    turned_grid,
    write_json,
    write_scan,
)
from ssmpipe.synth.implicit import (
    Field,
    ellipsoid,
    field_gradient,
    polygonize,
    project,
    round_cone,
    smooth_cut,
    smooth_union,
)

MODES = {
    "size": "uniform scale, 5 % per unit",
    "condyle_width": "medial and lateral condyle move apart, 2 mm each per unit; the shaft stays",
    "notch_width": "the walls of the intercondylar notch move apart, 2.2 mm each per unit; the epicondyles stay",
    "depth_and_angle": "posterior condyles 2.5 mm longer and the shaft tilted by 2 degrees per unit",
    "slide": "epicondyles slide up and the patellar groove slides laterally along the surface, 3 mm per unit",
}
"""Known modes and what one unit of their score does."""

LANDMARKS = ("LEC", "MEC", "PLC", "PMC", "DLC", "DMC", "ICN")
"""Lateral and medial epicondyle; most posterior and most distal point of each condyle; distal rim of the notch."""

TRUTH_TOP = 105.0
"""Height up to which the truth is given: above the cut of the usual chain [mm]."""

_LOWER, _UPPER = np.array([-48.0, -42.0, -8.0]), np.array([48.0, 34.0, 170.0])
_SCALE = 0.94


def template_field(points: Floats) -> Floats:
    """Return the implicit function of the template at (n, 3) points: negative inside, about the distance [mm].

    The shaft goes on without end; the cut comes with each scan.

    Examples
    --------
    >>> bool(template_field(np.array([[0.0, 5, 100]]))[0] < -10 < 10 < template_field(np.array([[60.0, 0, 20]]))[0])
    True
    """
    points = points / _SCALE
    body = round_cone(points, (2.0, 5.0, 70.0), (10.0, 5.0, 220.0), (15.5, 15.2))
    flare = smooth_union(
        round_cone(points, (2.5, 5.0, 96.0), (-24.0, -3.0, 30.0), (11.0, 15.0)),
        round_cone(points, (2.5, 5.0, 96.0), (23.0, -3.0, 29.0), (11.0, 14.5)),
        8.0,
    )
    body = smooth_union(body, flare, 12.0)
    body = smooth_union(body, ellipsoid(points, (0.0, 5.0, 42.0), (24.0, 14.0, 32.0)), 10.0)
    lateral = smooth_union(
        ellipsoid(points, (25.0, -16.0, 20.5), (14.0, 20.5, 19.5)),
        round_cone(points, (24.0, -8.0, 20.0), (17.0, 9.0, 20.0), (16.5, 16.0)),
        6.0,
    )
    medial = smooth_union(
        ellipsoid(points, (-25.5, -16.0, 18.0), (13.5, 20.0, 20.5)),
        round_cone(points, (-24.0, -8.0, 17.0), (-15.0, 6.5, 18.5), (16.5, 14.5)),
        6.0,
    )
    trochlea = smooth_union(
        round_cone(points, (18.0, 14.0, 18.0), (13.0, 14.0, 40.0), (11.5, 8.5)),
        round_cone(points, (-15.0, 12.0, 18.0), (-11.0, 12.0, 36.0), (10.0, 8.5)),
        8.0,
    )
    trochlea = smooth_union(trochlea, ellipsoid(points, (0.0, 8.0, 25.0), (17.0, 12.0, 18.0)), 6.0)
    body = smooth_union(smooth_union(body, smooth_union(lateral, medial, 4.0), 6.0), trochlea, 9.0)
    epicondyles = smooth_union(
        ellipsoid(points, (36.5, -6.0, 27.0), (4.5, 8.0, 8.0)),
        ellipsoid(points, (-37.5, -6.0, 30.0), (5.0, 8.5, 9.0)),
        2.0,
    )
    body = smooth_union(body, epicondyles, 11.0)
    body = smooth_union(body, ellipsoid(points, (-33.0, -9.0, 44.0), (4.0, 5.0, 5.5)), 8.0)
    notch = ellipsoid(points, (0.5, -25.0, 1.0), (10.5, 29.0, 25.0))
    body = smooth_cut(body, notch, 5.0)
    groove = smooth_union(
        round_cone(points, (1.0, 10.0, -11.5), (1.5, 31.0, 4.0), (10.0, 10.5)),
        round_cone(points, (1.5, 31.0, 4.0), (2.0, 35.5, 30.0), (10.5, 11.0)),
        4.0,
    )
    body = smooth_cut(body, groove, 9.0)
    popliteal = ellipsoid(points, (0.0, -34.0, 62.0), (27.0, 23.0, 34.0))
    return _SCALE * smooth_cut(body, popliteal, 10.0)


def _below(z: Floats, height: float, width: float) -> Floats:
    """Return 1 far below ``height`` and 0 far above it."""
    return 1 / (1 + np.exp(np.clip((z - height) / width, -60, 60)))


def _bump(points: Floats, centre: tuple[float, ...], widths: tuple[float, ...]) -> Floats:
    return np.exp(-0.5 * (((points - np.array(centre)) / np.array(widths)) ** 2).sum(axis=1))


def mode_fields(points: Floats) -> Floats:
    """Return the displacement fields of all modes, for one unit of their score.

    Parameters
    ----------
    points : (n, 3) float64
        In the template's frame [mm].

    Returns
    -------
    (n_modes, n, 3) float64
        In the order of :data:`MODES` [mm]. Far up the shaft all are affine, so that a flat cut stays flat.
    """
    x, y, z = points.T
    condyles = _below(z, 58.0, 6.0)
    fields = np.zeros((len(MODES), len(points), 3))
    fields[0] = 0.05 * points
    fields[1, :, 0] = 2.0 * np.tanh(x / 15.0) * condyles
    odd = x / 12.0 * np.exp(0.5 - 0.5 * (x / 12.0) ** 2)
    fields[2, :, 0] = 2.2 * odd * np.exp(-0.5 * ((y + 18.0) / 20.0) ** 2) * _below(z, 42.0, 6.0)
    fields[3, :, 1] = -2.5 * _below(y, -2.0, 6.0) * condyles
    fields[3, :, 0] = 0.035 * 10.0 * np.logaddexp(0.0, (z - 45.0) / 10.0)
    fields[4, :, 2] = 3.0 * (
        _bump(points, (37.0, -6.0, 26.0), (11.0, 13.0, 13.0)) + _bump(points, (-38.0, -6.0, 29.0), (11.0, 13.0, 13.0))
    )
    fields[4, :, 0] = 3.0 * _bump(points, (1.0, 20.0, 20.0), (15.0, 13.0, 20.0))
    return fields


def own_field(rng: np.random.Generator, n_bumps: int = 60, width: float = 20.0, rms: float = 0.6) -> Field:
    """Return a random smooth displacement field of one shape: (n, 3) points to (n, 3) vectors [mm].

    Gaussian bumps of the given ``width`` around the condyles, with ``rms`` displacement there, fading out up the shaft.
    """
    centres = rng.uniform(_LOWER - 10, np.array([58.0, 44.0, 90.0]), size=(n_bumps, 3))
    weights = rng.normal(size=(n_bumps, 3))
    probe = rng.uniform(_LOWER, np.array([48.0, 34.0, 70.0]), size=(500, 3))

    def field(points: Floats) -> Floats:
        squared = ((points[:, None, :] - centres) ** 2).sum(axis=2)
        return (np.exp(-0.5 * squared / width**2) @ weights) * _below(points[:, 2], 85.0, 6.0)[:, None]

    weights *= rms / np.sqrt((field(probe) ** 2).sum(axis=1).mean())
    return field


def deform(points: Floats, scores: Floats, own: Callable[[Floats], Floats] | None = None) -> Floats:
    """Move (n, 3) template points by ``T_i`` of a shape with these (n_modes,) scores.

    Examples
    --------
    >>> deform(np.array([[10.0, 0, 0]]), np.array([1.0, 0, 0, 0, 0])).tolist()
    [[10.5, 0.0, 0.0]]
    """
    moved = points + np.tensordot(scores[1:], mode_fields(points)[1:], axes=1)
    if own is not None:
        moved = moved + own(points)
    return (1 + 0.05 * scores[0]) * moved


def template_mesh(spacing: float = 3.6) -> tuple[Floats, Ints]:
    """Return the template's surface below :data:`TRUTH_TOP`: vertices exactly on it, triangles outward."""
    vertices, faces = polygonize(template_field, _LOWER, _UPPER, spacing, np.eye(4))
    faces = faces[(vertices[faces][:, :, 2] < TRUTH_TOP).all(axis=1)]
    used, index = np.unique(faces, return_inverse=True)
    return project(template_field, vertices[used]), index.reshape(-1, 3)


def template_landmarks(vertices: Floats) -> dict[str, Floats]:
    """Return the anatomical points of the template, chosen among its (n, 3) ``vertices``."""
    x, y, z = vertices.T
    found = {
        "LEC": np.argmax(x),
        "MEC": np.argmin(x),
        "PLC": np.argmin(np.where(x > 0, y, np.inf)),
        "PMC": np.argmin(np.where(x < 0, y, np.inf)),
        "DLC": np.argmin(np.where(x > 0, z, np.inf)),
        "DMC": np.argmin(np.where(x < 0, z, np.inf)),
        "ICN": np.argmin(np.where(np.abs(x) < 2, z, np.inf)),
    }
    return {name: vertices[found[name]] for name in LANDMARKS}


def cut_field(height: float, normal: Floats) -> Field:
    """Return the template's field with the shaft sawn off by the plane through (0, 0, height)."""

    def field(points: Floats) -> Floats:
        return np.maximum(template_field(points), (points - np.array([0.0, 0.0, height])) @ normal)

    return field


def raw_scan(scores: Floats, rng: np.random.Generator, own: Field, spacing: float, debris: bool) -> tuple[Floats, Ints]:
    """Return one raw-looking surface in the frame of a right femur.

    Its own marching-cubes grid, cut and terraces of the slices; noise of 0.12 mm with a grain of about 2 mm; if asked for,
    two specks of debris beside the bone.

    Returns
    -------
    vertices : (n, 3) float64
    faces : (m, 3) int64
        Closed, outward.
    """
    turn = turned_grid(rng, spacing)
    tilt = np.array([*rng.normal(scale=0.04, size=2), 1.0])
    field = cut_field(rng.uniform(115.0, 150.0), tilt / np.linalg.norm(tilt))
    vertices, faces = polygonize(field, _LOWER, _UPPER, spacing, turn)
    vertices = project(field, vertices, n_steps=2)
    normals = field_gradient(field, vertices)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    vertices = roughened(deform(vertices, scores, own), normals, rng)
    if debris:
        extra, triangles = specks(vertices, normals, rng)
        faces, vertices = np.concatenate([faces, triangles]), np.concatenate([vertices, extra])
    return vertices, faces


def write_cohort(out_dir: Path, n: int = 12, seed: int = 0, spacing: float = 2.2) -> None:
    """Write a cohort of raw-looking scans and the truth about them; the same seed gives the same bytes.

    Parameters
    ----------
    out_dir : Path
        Gets ``scans/<id>.ply``, ``cohort.csv`` (id, side, subject, group), ``landmarks.json``, ``truth.npz`` and
        ``truth.json``. In ``truth.npz``, in scan coordinates and without noise: ``points`` (n, n_T, 3) are the same
        template vertices in every shape, ``faces`` (n_F, 3) join them (outward on right femora), ``pose`` (n, 4, 4) leads
        from the right-femur frame to the scan, ``scores`` (n, n_modes); ``template`` (n_T, 3) and ``modes``
        (n_modes, n_T, 3), the displacement for one unit of score, are in the right-femur frame.
    n : int
        Number of shapes, at least 2; odd ones are right, even ones left. The larger half is group ``a``.
    seed : int
    spacing : float
        Grid spacing of the marching cubes [mm]: 2.2 gives about 13,000 faces, 2.9 about 7,500.
    """
    if n < 2:
        raise ValueError(f"a cohort needs at least 2 shapes, got {n}")
    scans = Path(out_dir) / "scans"
    scans.mkdir(parents=True, exist_ok=True)
    scores = spread_scores(n, len(MODES), np.random.default_rng([seed, 0]))
    template, truth_faces = template_mesh()
    landmarks = template_landmarks(template_mesh(2.0)[0])
    marks = np.array([landmarks[name] for name in LANDMARKS])
    ids = [f"femur_{i + 1:02d}" for i in range(n)]
    with_debris = {1, n - 2}
    points, poses, table, rows = [], [], {}, ["id,side,subject,group"]
    for i, shape_id in enumerate(ids):
        rng = np.random.default_rng([seed, i + 1])
        left = i % 2 == 1
        own, pose = own_field(rng), scanner_pose(rng, left)
        vertices, faces = raw_scan(scores[i], rng, own, spacing, i in with_debris)
        write_scan(scans / f"{shape_id}.ply", apply(pose, vertices), faces[:, ::-1] if left else faces)
        points.append(apply(pose, deform(template, scores[i], own)))
        poses.append(pose)
        moved = apply(pose, deform(marks, scores[i], own))
        table[shape_id] = {name: [round(c, 4) for c in p] for name, p in zip(LANDMARKS, moved.tolist(), strict=True)}
        group = "a" if scores[i, 0] >= np.median(scores[:, 0]) else "b"
        rows.append(f"{shape_id},{'L' if left else 'R'},subject_{i + 1:02d},{group}")
    truth = {
        "ids": np.array(ids),
        "points": np.array(points),
        "faces": truth_faces,
        "pose": np.array(poses),
        "scores": scores,
        "template": template,
        "modes": mode_fields(template),
        "mode_names": np.array(list(MODES)),
    }
    np.savez(Path(out_dir) / "truth.npz", **truth)  # type: ignore[arg-type]
    (Path(out_dir) / "cohort.csv").write_text("\n".join(rows) + "\n", encoding="utf-8", newline="\n")
    write_json(Path(out_dir) / "landmarks.json", table)
    write_json(
        Path(out_dir) / "truth.json",
        {
            "seed": seed,
            "units": "mm",
            "frame": "right femur: x lateral, y anterior, z proximal; left femora are mirrored in x before the pose",
            "formula": "x_i = pose_i (1 + 0.05 score_size) (x + sum over the other modes of score * mode(x) + own_i(x))",
            "modes": MODES,
            "own_variation_rms_mm": 0.6,
            "noise_rms_mm": 0.12,
            "debris": [ids[i] for i in sorted(with_debris)],
            "scores": {
                shape_id: dict(zip(MODES, row, strict=True)) for shape_id, row in zip(ids, scores.tolist(), strict=True)
            },
        },
    )
