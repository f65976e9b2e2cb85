"""Proximal femora with known correspondence: healthy ones, or with ``--groups`` 13 healthy and 16 with a cam bump on the neck.

One template, moved by known smooth maps, made to look like raw scans. The template is an implicit body in the frame of a right
femur: x lateral, y anterior, z proximal along the shaft, the lesser trochanter at height 0 [mm]. Shape ``i`` is ``T_i`` of it,

    T_i(x) = s_i (x + sum_k a_ik d_k(x) + c_i(x) + e_i(x)),      s_i = 1 + 0.04 a_i,size

with fields ``d_k`` that are the same for all, a cam bump ``c_i`` of known height and place where the subject is ill, and a small
smooth field ``e_i`` of its own. Hence the true correspondence is exact: a template point and its images. The cohort follows
table 5.1 and figure 5.2 of Li (2015): several bones of one patient, left and right mixed, meshes of very different density,
shafts of different length, stray triangles, and on one bone an artificial platform, left by a misplaced cut.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import igl
import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import ConfigError
from ssmpipe.synth._scans import (
    apply,
    roughened,
    rounded,
    scanner_pose,
    shuffled,
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

OPTIONS = {"groups": "Healthy bones and bones with a cam bump, 13 and 16 of 29, several of one subject, with outliers."}
"""Switches of the command line."""

MODES = {
    "size": "uniform scale, 4 % per unit",
    "neck_angle": "head and neck turn upwards by 3.5 degrees per unit",
    "anteversion": "head and neck turn forwards by 5 degrees per unit",
    "neck_length": "the head moves 2 mm along the neck per unit",
    "head_radius": "the head grows by 3.5 % per unit about its centre",
    "head_twist": "the head turns about the neck by 5 degrees per unit: the fovea slides along the surface",
    "greater_trochanter": "its tip moves 2.5 mm up and outwards per unit",
    "lesser_trochanter": "its tip moves 1.5 mm out and 1.5 mm up per unit",
    "shaft_radius": "the shaft is 5 % thicker per unit",
}
"""Known modes and what one unit of their score does."""

LANDMARKS = ("FOVEA", "SFH", "AFH", "PFH", "IFH", "SNI", "ANI", "PNI", "INI", "SGT", "LT", "CAM")
"""Fovea; superior, anterior, posterior and inferior point of the head and of the neck's isthmus; tips of the greater and the
lesser trochanter; the middle of the cam bump, or its place on a healthy bone."""

TRUTH_BOTTOM = -32.0
"""Height down to which the truth is given: below the cut of the usual chain [mm]."""

COVERED = 0.6
"""The scan covers a true point when it passes by within this distance [mm]."""

CAM_WIDTH = 6.5
"""Standard deviation of the cam bump along the surface [mm]."""

HEAD, HEAD_RADIUS = np.array([-33.0, 8.0, 69.0]), 23.5
NECK_BASE = np.array([0.0, 6.0, 37.0])
NECK = (HEAD - NECK_BASE) / np.linalg.norm(HEAD - NECK_BASE)
_UP = np.cross(np.cross(NECK, [0.0, 0.0, 1.0]), NECK)
_UP = _UP / np.linalg.norm(_UP)
_FRONT = np.cross(_UP, NECK) * np.sign(np.cross(_UP, NECK)[1])
_FOVEA = np.array([-0.93, -0.20, -0.30]) / np.linalg.norm([-0.93, -0.20, -0.30])
_LOWER, _UPPER = np.array([-64.0, -34.0, -95.0]), np.array([40.0, 38.0, 98.0])


def template_field(points: Floats) -> Floats:
    """Return the implicit function of the template at (n, 3) points: negative inside, about the distance [mm].

    The shaft goes on without end; the cut comes with each scan.

    Examples
    --------
    >>> bool(template_field(np.array([[0.0, 0, -50]]))[0] < -10 < 10 < template_field(np.array([[30.0, 0, -50]]))[0])
    True
    """
    body = round_cone(points, (1.0, -1.0, -260.0), (0.0, 0.0, -10.0), (14.0, 15.5))
    flare = smooth_union(
        round_cone(points, (0.0, 0.0, -60.0), (-8.0, 4.0, 30.0), (11.0, 15.5)),
        round_cone(points, (1.0, 0.0, -60.0), (11.5, 1.0, 34.0), (11.0, 14.5)),
        6.0,
    )
    body = smooth_union(body, flare, 8.0)
    neck = round_cone(points, tuple(NECK_BASE), tuple(HEAD - 8.0 * NECK), (16.5, 15.5))
    body = smooth_union(body, neck, 8.0)
    greater = smooth_union(
        ellipsoid(points, (17.0, 1.0, 38.0), (13.5, 17.0, 21.0)),
        smooth_union(
            ellipsoid(points, (19.0, -8.0, 50.0), (8.5, 13.0, 14.5)),
            ellipsoid(points, (21.0, 6.0, 46.0), (7.5, 10.0, 10.0)),
            5.0,
        ),
        6.0,
    )
    crest = smooth_union(
        round_cone(points, (17.0, -14.5, 50.0), (13.0, -14.5, 27.0), (6.5, 5.5)),
        round_cone(points, (13.0, -14.5, 27.0), (-7.0, -12.0, 2.0), (5.5, 5.0)),
        3.0,
    )
    body = smooth_union(body, smooth_union(greater, crest, 6.0), 6.0)
    body = smooth_union(body, ellipsoid(points, (-10.0, -13.5, 0.0), (7.5, 7.5, 9.5)), 9.0)
    fossa = ellipsoid(points, (3.0, -17.0, 54.0), (10.0, 9.0, 12.0))
    body = smooth_cut(body, fossa, 6.0)
    head = ellipsoid(points, tuple(HEAD), (HEAD_RADIUS,) * 3)
    body = smooth_union(body, head, 5.0)
    fovea = ellipsoid(points, tuple(HEAD + (HEAD_RADIUS + 2.5) * _FOVEA), (5.5,) * 3)
    return smooth_cut(body, fovea, 3.0)


def _above(values: Floats, level: float, width: float) -> Floats:
    """Return 0 far below ``level`` and 1 far above it."""
    return 1 / (1 + np.exp(-np.clip((values - level) / width, -60, 60)))


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
        In the order of :data:`MODES` [mm]. Far down the shaft all are affine, so that a flat cut stays flat.
    """
    from_base, from_head = points - NECK_BASE, points - HEAD
    beyond = _above(from_base @ NECK, 14.0, 3.5)[:, None]
    ball = _above(-np.linalg.norm(from_head, axis=1), -31.0, 2.5)[:, None]
    fields = np.zeros((len(MODES), len(points), 3))
    fields[0] = 0.04 * points
    fields[1] = np.deg2rad(3.5) * beyond * np.cross([0.0, 1.0, 0.0], from_base)
    fields[2] = np.deg2rad(-5.0) * beyond * np.cross([0.0, 0.0, 1.0], from_base)
    fields[3] = 2.0 * _above(from_base @ NECK, 20.0, 5.0)[:, None] * NECK
    fields[4] = 0.035 * ball * from_head
    fields[5] = np.deg2rad(5.0) * ball * np.cross(NECK, from_head)
    fields[6] = 2.5 * _bump(points, (20.0, -4.0, 54.0), (13.0, 16.0, 12.0))[:, None] * [0.45, 0.0, 0.893]
    fields[7] = 1.5 * _bump(points, (-13.0, -17.0, 0.0), (10.0, 10.0, 11.0))[:, None] * [-0.6, -0.8, 1.0]
    fields[8, :, :2] = 0.05 * points[:, :2] * (1 - _above(points[:, 2], 2.0, 5.0))[:, None]
    return fields


@dataclass(frozen=True)
class Cam:
    """A smooth bump where the head meets the neck.

    Parameters
    ----------
    height : float
        Of its middle [mm]; 0 on a healthy bone.
    angle : float
        About the neck, from superior (0) towards anterior (90) [degrees].
    """

    height: float
    angle: float = 45.0

    @property
    def direction(self) -> Floats:
        """Unit vector, (3,), from the axis of the neck to the bump."""
        a = np.deg2rad(self.angle)
        return np.asarray(np.cos(a) * _UP + np.sin(a) * _FRONT)

    @property
    def place(self) -> Floats:
        """The middle of the bump on the template, (3,) [mm]."""
        rough = HEAD - 0.62 * HEAD_RADIUS * NECK + 0.78 * HEAD_RADIUS * self.direction
        return project(template_field, rough[None])[0]

    def displacement(self, points: Floats) -> Floats:
        """Return the (n, 3) displacement of template points [mm]."""
        squared = ((points - self.place) ** 2).sum(axis=1)
        return self.height * np.exp(-0.5 * squared / CAM_WIDTH**2)[:, None] * self.direction


def own_field(rng: np.random.Generator, n_bumps: int = 60, width: float = 18.0, rms: float = 0.5) -> Field:
    """Return a random smooth displacement field of one shape: (n, 3) points to (n, 3) vectors [mm].

    Gaussian bumps of the given ``width``, with ``rms`` displacement where the truth is given, fading out down the shaft.
    """
    lower = np.array([_LOWER[0], _LOWER[1], TRUTH_BOTTOM])
    centres = rng.uniform(lower, _UPPER, size=(n_bumps, 3))
    weights = rng.normal(size=(n_bumps, 3))
    probe = rng.uniform(lower, _UPPER, size=(500, 3))

    def field(points: Floats) -> Floats:
        squared = ((points[:, None, :] - centres) ** 2).sum(axis=2)
        return (np.exp(-0.5 * squared / width**2) @ weights) * _above(points[:, 2], -20.0, 5.0)[:, None]

    weights *= rms / np.sqrt((field(probe) ** 2).sum(axis=1).mean())
    return field


def deform(points: Floats, scores: Floats, cam: Cam, own: Callable[[Floats], Floats] | None = None) -> Floats:
    """Move (n, 3) template points by ``T_i`` of a shape with these (n_modes,) scores.

    Examples
    --------
    >>> deform(np.array([[10.0, 0, 0]]), np.eye(9)[0], Cam(0.0)).tolist()
    [[10.4, 0.0, 0.0]]
    """
    moved = points + np.tensordot(scores[1:], mode_fields(points)[1:], axes=1) + cam.displacement(points)
    if own is not None:
        moved = moved + own(points)
    return np.asarray((1 + 0.04 * scores[0]) * moved)


def template_mesh(spacing: float = 3.2) -> tuple[Floats, Ints]:
    """Return the template's surface above :data:`TRUTH_BOTTOM`: vertices exactly on it, triangles outward."""
    vertices, faces = polygonize(template_field, _LOWER, _UPPER, spacing, np.eye(4))
    faces = faces[(vertices[faces][:, :, 2] > TRUTH_BOTTOM).all(axis=1)]
    used, index = np.unique(faces, return_inverse=True)
    return project(template_field, vertices[used]), index.reshape(-1, 3)


def template_landmarks(vertices: Floats) -> dict[str, Floats]:
    """Return the anatomical points of the template; both tips are chosen among its (n, 3) ``vertices``."""
    isthmus = HEAD - 27.0 * NECK
    compass = np.stack([_UP, _FRONT, -_FRONT, -_UP])
    around = np.concatenate(
        [HEAD + HEAD_RADIUS * np.array([[0, 0, 1.0], [0, 1, 0], [0, -1, 0]]), [HEAD + HEAD_RADIUS * _FOVEA]]
    )
    inferior = HEAD + HEAD_RADIUS * np.array([-0.35, 0.0, -0.937])
    found = project(template_field, np.concatenate([around, [inferior], isthmus + 15.5 * compass]))
    lateral, near = vertices[vertices[:, 0] > 8], vertices[np.abs(vertices[:, 2]) < 8]
    tips = [lateral[np.argmax(lateral[:, 2])], near[np.argmax(near @ [-0.6, -0.8, 0.0])]]
    superior, anterior, posterior, fovea, inferior, *neck = found
    return dict(
        zip(LANDMARKS, [fovea, superior, anterior, posterior, inferior, *neck, *tips, Cam(0.0).place], strict=True)
    )


@dataclass(frozen=True)
class Bone:
    """One row of the cohort.

    Parameters
    ----------
    subject : int
    left : bool
    scores : (n_modes,) float64
    cam : Cam
    outlier : str
        Empty, ``size`` or ``shape``.
    """

    subject: int
    left: bool
    scores: Floats
    cam: Cam
    outlier: str = ""


def healthy_bones(n: int, seed: int) -> list[Bone]:
    """Return ``n`` healthy bones of ``n`` subjects, right and left in turn."""
    scores = spread_scores(n, len(MODES), np.random.default_rng([seed, 0]))
    return [Bone(i, i % 2 == 1, row, Cam(0.0)) for i, row in enumerate(scores)]


def grouped_bones(n: int, seed: int) -> list[Bone]:
    """Return bones in the proportions of table 5.1: of 29, 16 with a cam bump; 12 subjects with two bones and 5 with one.

    Two bones of one subject differ by a fifth of the variation between subjects; one is healthy, the other one is not. The third
    subject is an outlier by size, 16 % smaller than the mean, the bones of the sixth by shape: neck angle and anteversion.
    """
    rng = np.random.default_rng([seed, 0])
    n_cam = round(n * 16 / 29)
    n_pairs = min(round(n * 12 / 29), n_cam, n - n_cam)
    ill = [True, False] * n_pairs + [True] * (n_cam - n_pairs) + [False] * (n - n_cam - n_pairs)
    subjects = [k // 2 for k in range(2 * n_pairs)] + list(range(n_pairs, n - n_pairs))
    scores = spread_scores(n - n_pairs, len(MODES), rng)
    outliers = {2: "size", 5: "shape"}
    if n - n_pairs > 2:
        scores[2, 0] = -4.0
    if n - n_pairs > 5:
        scores[5, 1:3] = 3.0, -3.0
    heights = rng.permutation(np.linspace(2.5, 5.5, n_cam))
    first_left = rng.random(n - n_pairs) < 0.5
    bones, cams = [], iter(heights.tolist())
    for k, (subject, sick) in enumerate(zip(subjects, ill, strict=True)):
        left = bool(first_left[subject]) != (k % 2 == 1 and k < 2 * n_pairs)
        personal = scores[subject] + 0.2 * rng.normal(size=len(MODES))
        cam = Cam(next(cams), 45.0 + 12.0 * float(np.clip(rng.normal(), -2, 2))) if sick else Cam(0.0)
        bones.append(Bone(subject, left, personal, cam, outliers.get(subject, "")))
    return bones


@dataclass(frozen=True)
class Flaws:
    """What is wrong with one scan.

    Parameters
    ----------
    shaft : float
        Height of the cut of the shaft [mm].
    spacing : float
        Of the marching cubes [mm].
    platform : bool
        Whether a misplaced flat cut takes the top of the head away.
    debris : bool
        Whether there are stray triangles and specks.
    """

    shaft: float
    spacing: float
    platform: bool
    debris: bool


def draw_flaws(index: int, n: int, groups: bool, spacing: float, rng: np.random.Generator) -> Flaws:
    """Return the flaws of bone ``index`` of ``n``; the platform is on the first one with ``groups``."""
    return Flaws(
        shaft=rng.uniform(-85.0, -45.0),
        spacing=spacing * rng.uniform(0.8, 1.35),
        platform=groups and index == 0,
        debris=index in {1, n - 2},
    )


def scan_field(flaws: Flaws, tilt: Floats) -> Field:
    """Return the template's field with the shaft sawn off and, where asked for, a platform on top of the head."""
    platform = np.array([-0.35, 0.1, 0.93]) / np.linalg.norm([-0.35, 0.1, 0.93])

    def field(points: Floats) -> Floats:
        values = np.maximum(template_field(points), -(points - [0.0, 0.0, flaws.shaft]) @ tilt)
        if flaws.platform:
            values = np.maximum(values, (points - HEAD) @ platform - 0.82 * HEAD_RADIUS)
        return values

    return field


def raw_scan(bone: Bone, flaws: Flaws, own: Field, rng: np.random.Generator) -> tuple[Floats, Ints]:
    """Return one raw-looking surface in the frame of a right femur.

    Its own marching-cubes grid and cut, terraces of the slices, noise of 0.12 mm with a grain of about 2 mm.

    Returns
    -------
    vertices : (n, 3) float64
    faces : (m, 3) int64
        Closed but for stray triangles, outward, in random order.
    """
    tilt = np.array([*rng.normal(scale=0.04, size=2), 1.0])
    field = scan_field(flaws, tilt / np.linalg.norm(tilt))
    turn = turned_grid(rng, flaws.spacing)
    vertices, faces = polygonize(field, _LOWER, _UPPER, flaws.spacing, turn)
    vertices = project(field, vertices, n_steps=2)
    normals = field_gradient(field, vertices)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    vertices = roughened(deform(vertices, bone.scores, bone.cam, own), normals, rng)
    if flaws.debris:
        extra, triangles = specks(vertices, normals, rng)
        stray = vertices[rng.integers(0, len(vertices), 4)][:, None] + rng.normal(scale=4.0, size=(4, 3, 3))
        faces = np.concatenate([faces, triangles, len(vertices) + len(extra) + np.arange(12).reshape(4, 3)])
        vertices = np.concatenate([vertices, extra, stray.reshape(-1, 3)])
    return shuffled(vertices, faces, rng)


def write_cohort(
    out_dir: Path, n: int | None = None, seed: int = 0, groups: bool = False, spacing: float = 1.7
) -> None:
    """Write a cohort of raw-looking scans and the truth about them; the same seed gives the same bytes.

    Parameters
    ----------
    out_dir : Path
        Gets ``scans/<id>.stl``, ``cohort.csv`` (id, side, subject, group), ``landmarks.json``, ``truth.npz`` and
        ``truth.json``. In ``truth.npz``, in scan coordinates and without noise and bumps of debris: ``points`` (n, n_T, 3) are
        the same template vertices in every shape, ``faces`` (n_F, 3) join them (outward on right femora), ``covered`` (n, n_T)
        tells which of them the scan really shows, ``pose`` (n, 4, 4) leads from the right-femur frame to the scan, ``scores``
        (n, n_modes), ``cam_height`` and ``cam_angle`` (n,) [mm, degrees], ``cam`` (n, n_T) height of the bump at every point
        [mm], ``landmarks`` (n, n_L, 3) and ``landmark_names``; ``template`` (n_T, 3) and ``modes`` (n_modes, n_T, 3), the
        displacement for one unit of score, are in the right-femur frame.
    n : int, optional
        Number of shapes, at least 3; 12 by default, 29 with ``groups``.
    seed : int
    groups : bool, default=False
        Healthy bones and bones with a cam bump as in table 5.1, with outliers and a misplaced cut; otherwise all are healthy.
    spacing : float
        Mean grid spacing of the marching cubes [mm]: each scan has 0.8 to 1.35 times of it; 1.7 gives 9,000 to 25,000 faces.

    Raises
    ------
    ConfigError
        If there are fewer than 3 shapes.
    """
    n = (29 if groups else 12) if n is None else n
    if n < 3:
        raise ConfigError(f"a cohort of proximal femora needs at least 3 shapes, got {n}", "raise --n")
    scans = Path(out_dir) / "scans"
    scans.mkdir(parents=True, exist_ok=True)
    bones = grouped_bones(n, seed) if groups else healthy_bones(n, seed)
    template, truth_faces = template_mesh()
    marks = np.array(list(template_landmarks(template_mesh(1.8)[0]).values()))
    ids = [f"hip_{i + 1:02d}" for i in range(n)]
    points, covered, poses, landmarks, flaws = [], [], [], [], []
    for i, (shape_id, bone) in enumerate(zip(ids, bones, strict=True)):
        rng = np.random.default_rng([seed, i + 1])
        own, pose = own_field(rng), scanner_pose(rng, bone.left)
        flaws.append(draw_flaws(i, n, groups, spacing, rng))
        vertices, faces = raw_scan(bone, flaws[-1], own, rng)
        write_scan(scans / f"{shape_id}.stl", apply(pose, vertices), faces[:, ::-1] if bone.left else faces)
        truth = deform(template, bone.scores, bone.cam, own)
        covered.append(igl.point_mesh_squared_distance(truth, vertices, faces)[0] < COVERED**2)
        points.append(apply(pose, truth))
        poses.append(pose)
        marks[-1] = bone.cam.place
        landmarks.append(apply(pose, deform(marks, bone.scores, bone.cam, own)))
    arrays = {
        "ids": np.array(ids),
        "points": np.array(points),
        "covered": np.array(covered),
        "faces": truth_faces,
        "pose": np.array(poses),
        "scores": np.array([bone.scores for bone in bones]),
        "cam_height": np.array([bone.cam.height for bone in bones]),
        "cam_angle": np.array([bone.cam.angle for bone in bones]),
        "cam": np.array([np.linalg.norm(bone.cam.displacement(template), axis=1) for bone in bones]),
        "landmark_names": np.array(LANDMARKS),
        "landmarks": np.array(landmarks),
        "template": template,
        "modes": mode_fields(template),
        "mode_names": np.array(list(MODES)),
    }
    np.savez(Path(out_dir) / "truth.npz", **arrays)  # type: ignore[arg-type]
    rows = ["id,side,subject,group"]
    for shape_id, bone in zip(ids, bones, strict=True):
        group = "cam" if bone.cam.height > 0 else "healthy"
        rows.append(f"{shape_id},{'L' if bone.left else 'R'},subject_{bone.subject + 1:02d},{group}")
    (Path(out_dir) / "cohort.csv").write_text("\n".join(rows) + "\n", encoding="utf-8", newline="\n")
    named = {
        shape_id: {name: rounded(p) for name, p in zip(LANDMARKS, places, strict=True)}
        for shape_id, places in zip(ids, landmarks, strict=True)
    }
    write_json(Path(out_dir) / "landmarks.json", named)
    write_json(
        Path(out_dir) / "truth.json",
        {
            "seed": seed,
            "units": "mm",
            "frame": "right femur: x lateral, y anterior, z proximal; left femora are mirrored in x before the pose",
            "formula": "x_i = pose_i (1 + 0.04 score_size) (x + sum over the other modes of score * mode(x) + cam_i(x) + own_i(x))",
            "modes": MODES,
            "own_variation_rms_mm": 0.5,
            "noise_rms_mm": 0.12,
            "covered_within_mm": COVERED,
            "cam": {
                shape_id: {"height_mm": round(bone.cam.height, 3), "angle_deg": round(bone.cam.angle, 3)}
                for shape_id, bone in zip(ids, bones, strict=True)
                if bone.cam.height > 0
            },
            "cam_width_mm": CAM_WIDTH,
            "outliers": {s: bone.outlier for s, bone in zip(ids, bones, strict=True) if bone.outlier},
            "platform": [s for s, flaw in zip(ids, flaws, strict=True) if flaw.platform],
            "debris": [s for s, flaw in zip(ids, flaws, strict=True) if flaw.debris],
            "shaft_cut_mm": {s: round(flaw.shaft, 3) for s, flaw in zip(ids, flaws, strict=True)},
            "scores": {
                s: dict(zip(MODES, bone.scores.tolist(), strict=True)) for s, bone in zip(ids, bones, strict=True)
            },
        },
    )
