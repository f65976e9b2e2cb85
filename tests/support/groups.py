"""Cohorts in groups: with no difference at all, and femora whose difference is known."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from ssmpipe.core.align.procrustes import generalized_procrustes
from ssmpipe.core.arrays import Floats
from ssmpipe.core.mesh.grid import grid_faces
from ssmpipe.core.statistics.comparison import Sample
from ssmpipe.synth.femur_proximal import deform, grouped_bones, own_field, template_mesh
from tests.support.models import grid_points


@dataclass(frozen=True, eq=False)
class CamFemora:
    """Proximal femora of a grouped synthetic cohort, by their true correspondence, and the mean height of the bump [mm]."""

    sample: Sample
    bump: Floats
    names: tuple[str, str] = ("healthy", "cam")


@cache
def cam_femora(seed: int = 0, spacing: float = 4.0, n: int = 29) -> CamFemora:
    """Return the truth of ``ssmpipe synth femur-proximal --groups``: 13 healthy bones and 16 with a cam bump, of 17 subjects."""
    bones = grouped_bones(n, seed)
    template, faces = template_mesh(spacing)
    points = np.array(
        [
            deform(template, bone.scores, bone.cam, own_field(np.random.default_rng([seed, i + 1])))
            for i, bone in enumerate(bones)
        ]
    )
    found = generalized_procrustes(points, np.full(len(template), 1 / len(template)), remove_size=False)
    aligned = np.einsum("iab,ilb->ila", found.rotation, points) + found.translation[:, None]
    labels = np.array([int(bone.cam.height > 0) for bone in bones])
    bump = np.array([np.linalg.norm(bone.cam.displacement(template), axis=1) for bone in bones])
    sample = Sample(aligned, labels, np.array([bone.subject for bone in bones]), faces)
    return CamFemora(sample, bump[labels == 1].mean(axis=0))


def null_cohort(seed: int, *, n_subjects: int = 17, kind: str = "pairs", covariate: bool = False) -> Sample:
    """Return smooth random surfaces of groups that do not differ.

    ``kind``: "single", one shape of each subject; "pairs", two shapes of most subjects that are much alike, both in one group;
    "mixed", the same with groups that differ inside of subjects; "three", three groups. With ``covariate``, shape depends on a
    covariate that depends on the group.
    """
    rng = np.random.default_rng([seed, 77])
    base = grid_points("disk", 9, 7)
    n_pairs = 0 if kind in ("single", "three") else 12
    subjects = np.sort(np.concatenate([np.arange(n_subjects), np.arange(n_pairs)]))
    group_of = rng.permuted(np.arange(n_subjects) % (3 if kind == "three" else 2))
    if kind == "mixed":
        labels = np.array([k % 2 for k in range(2 * n_pairs)] + [k % 2 for k in range(n_subjects - n_pairs)])
    else:
        labels = group_of[subjects]
    apart = ((base[:, None] - base) ** 2).sum(axis=-1)
    smooth = np.linalg.cholesky(np.exp(-apart / (2 * 8.0**2)) + 1e-6 * np.eye(len(base)))
    person = rng.standard_normal((n_subjects, len(base), 3))[subjects]
    own = rng.standard_normal((len(subjects), len(base), 3))
    points = base + np.einsum("lk,ikd->ild", smooth, person + 0.4 * own)
    covariates = None
    if covariate:
        age = 1.0 * labels + rng.standard_normal(n_subjects)[subjects]
        points = points + age[:, None, None] * smooth[:, :1] * [0.0, 0.0, 2.0]
        covariates = age[:, None]
    return Sample(points, labels, subjects, grid_faces(9, 7), covariates=covariates)
