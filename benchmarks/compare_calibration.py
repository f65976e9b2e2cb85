"""Rejection rates of `ssmpipe compare` on cohorts without any difference: 200 of each kind, level 0.05."""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from scipy import stats
from scipy.interpolate import RectBivariateSpline

from ssmpipe.core.arrays import Floats
from ssmpipe.core.mesh.grid import grid_faces
from ssmpipe.core.model.shape_model import ShapeModel
from ssmpipe.core.statistics.comparison import Options, Sample, compare_groups
from ssmpipe.use.matching import match_results
from tests.support.groups import null_cohort
from tests.support.models import grid_points

KINDS = {
    "single": "one shape of each of 24 subjects",
    "pairs": "36 shapes of 24 subjects, groups differ between subjects",
    "mixed": "36 shapes of 24 subjects, groups differ inside of subjects",
    "three": "three groups",
    "paired": "the 12 subjects of 'mixed' with both, paired",
    "covariate": "a covariate that goes with the group, removed",
    "ignored": "'pairs' as if all shapes were independent: what goes wrong",
}


def two_results(seed: int) -> dict[str, Sample]:
    """Two groups of one population; the points of the second slide along the surfaces, all in the same way, as in a run of its own."""
    rng = np.random.default_rng([seed, 5])
    grid, faces = (25, 19), grid_faces(25, 19)
    base = grid_points("disk", *grid)
    apart = ((base[:, None] - base) ** 2).sum(axis=-1)
    smooth = np.linalg.cholesky(np.exp(-apart / (2 * 8.0**2)) + 1e-8 * np.eye(len(base)))
    points = base + 0.5 * np.einsum("lk,ikd->ild", smooth, rng.standard_normal((24, len(base), 3)))
    u, v = (np.linspace(0, 1, n) for n in grid)
    at_u, at_v = np.meshgrid(u, v, indexing="ij")
    bulge = np.sin(np.pi * at_u) * np.sin(np.pi * at_v)
    slide = 0.06 * rng.normal(size=2)
    first, second = points[:12], points[12:].copy()
    for shape in second:
        for d in range(3):
            surface = RectBivariateSpline(u, v, shape[:, d].reshape(grid))
            shape[:, d] = surface.ev(at_u + slide[0] * bulge, at_v + slide[1] * bulge).ravel()

    def model(mean: Floats) -> ShapeModel:
        none = np.empty((0, *mean.shape))
        return ShapeModel((), mean, none, np.empty(0), np.empty((0, 0)), grid, faces, "disk")

    matched = match_results(model(first.mean(axis=0)), first, model(second.mean(axis=0)), second).points
    labels = np.repeat([0, 1], 12)
    return {
        "matched": Sample(matched, labels, np.arange(24), faces),
        "by number": Sample(np.concatenate([first, second]), labels, np.arange(24), faces),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cohorts", type=int, default=200)
    n = parser.parse_args().cohorts
    low, high = stats.binom.interval(0.95, n, 0.05)
    print(f"{n} cohorts, 199 permutations each; 95 % binomial interval of the rate: {low / n:.3f} to {high / n:.3f}")
    print(f"{'cohort':10} {'modes':>7} {'whole':>7} {'anywhere':>9} {'any mode':>9}")
    for kind, text in KINDS.items():
        rejected = np.zeros(4)
        for seed in range(n):
            cohort = {"paired": "mixed", "covariate": "single", "ignored": "pairs"}.get(kind, kind)
            sample = null_cohort(seed, kind=cohort, n_subjects=24, covariate=kind == "covariate")
            if kind == "ignored":
                sample = replace(sample, subjects=np.arange(len(sample.labels)))
            options = Options(n_permutations=199, n_shuffles=10, paired=kind == "paired")
            found = compare_groups(sample, options, seed)
            p = np.array([found.joint.p, found.whole.p, found.p_anywhere, found.mode_tests.p_family.min()])
            rejected += p <= 0.05
        rates = rejected / n
        print(f"{kind:10} {rates[0]:7.3f} {rates[1]:7.3f} {rates[2]:9.3f} {rates[3]:9.3f}   {text}", flush=True)
    rejected_of: dict[str, Floats] = {}
    for seed in range(n):
        for name, sample in two_results(seed).items():
            found = compare_groups(sample, Options(n_permutations=199, n_shuffles=5), seed)
            p = np.array([found.joint.p, found.whole.p, found.p_anywhere, found.mode_tests.p_family.min()])
            rejected_of[name] = rejected_of.get(name, np.zeros(4)) + (p <= 0.05)
    for name, rejected in rejected_of.items():
        rates = rejected / n
        text = f"two results, points {'matched along normals' if name == 'matched' else 'taken by their number'}"
        print(f"{name:10} {rates[0]:7.3f} {rates[1]:7.3f} {rates[2]:9.3f} {rates[3]:9.3f}   {text}")


if __name__ == "__main__":
    main()
