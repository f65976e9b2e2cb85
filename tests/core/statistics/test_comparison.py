from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from ssmpipe.core.errors import ConfigError
from ssmpipe.core.statistics.comparison import Options, Sample, compare_groups
from tests.support.groups import cam_femora, null_cohort

FAST = Options(n_permutations=999, n_shuffles=20)


@pytest.fixture(scope="module")
def femora():
    return compare_groups(cam_femora().sample, replace(FAST, n_permutations=4999), seed=0)


def test_the_cam_bump_is_found_where_it_is_and_nowhere_else(femora):
    bump, pair = cam_femora().bump, femora.pairs[0]
    peak = int(bump.argmax())
    points = femora.mean
    assert np.linalg.norm(points[int(pair.distance.argmax())] - points[peak]) < 6.0
    assert pair.distance[peak] == pytest.approx(bump[peak], abs=1.2)
    on, off = bump > 0.5 * bump.max(), bump < 0.02 * bump.max()
    assert (pair.along_normal.p_family[on] <= 0.05).mean() > 0.8
    assert (pair.along_normal.q[on] <= 0.05).mean() > 0.7
    assert (pair.along_normal.q[off] <= 0.05).mean() == 0
    assert np.all(pair.distance[pair.along_normal.q <= 0.05] > 0)
    assert pair.p_anywhere <= 0.001


def test_the_paired_comparison_finds_it_too():
    sample, bump = cam_femora().sample, cam_femora().bump
    pair = compare_groups(sample, replace(FAST, paired=True), seed=0).pairs[0]
    assert len(pair.pairs.subjects) == 12
    assert pair.n_rearrangements == 4096
    assert pair.p_anywhere <= 0.05
    assert bump[int(pair.distance.argmax())] > 0.5 * bump.max()


def test_swapping_the_groups_changes_only_signs(femora):
    sample = cam_femora().sample
    other = compare_groups(replace(sample, labels=1 - sample.labels), replace(FAST, n_permutations=4999), seed=0)
    one, two = femora.pairs[0], other.pairs[0]
    assert np.allclose(one.distance, -two.distance)
    assert np.allclose(one.effects.g, -two.effects.g)
    assert np.allclose(one.discriminant.scores, -two.discriminant.scores)
    assert np.array_equal(one.along_normal.p_family, two.along_normal.p_family)
    assert (one.joint.p, one.whole.p, one.p_anywhere) == (two.joint.p, two.whole.p, two.p_anywhere)
    assert one.mahalanobis == pytest.approx(two.mahalanobis)


def test_the_same_seed_gives_the_same_numbers_another_one_others():
    sample = null_cohort(3)
    a, b, c = (compare_groups(sample, FAST, seed=seed) for seed in (1, 1, 2))
    assert a.joint.p == b.joint.p
    assert a.pairs[0].along_normal.p.tobytes() == b.pairs[0].along_normal.p.tobytes()
    assert not np.array_equal(a.pairs[0].along_normal.p, c.pairs[0].along_normal.p)
    assert a.joint.trace == c.joint.trace


def test_two_groups_give_one_pair_with_the_tests_of_all():
    found = compare_groups(null_cohort(0), FAST)
    assert len(found.pairs) == 1
    assert found.joint == found.pairs[0].joint
    assert found.p_holm[0] == found.joint.p
    assert found.mode_tests.p_joint[-1] == found.joint.p
    assert np.isfinite(found.joint.t_squared)
    gap = found.group_means[1] - found.group_means[0]
    assert np.allclose(found.pairs[0].displacement, gap)
    assert np.allclose(np.einsum("ld,ld->l", gap, found.normals), found.pairs[0].distance)


def test_three_groups_have_three_pairs_and_the_different_one_is_found():
    sample = null_cohort(1, n_subjects=36, kind="three")
    points = sample.points.copy()
    points[sample.labels == 2, :20, 2] += 3.0
    found = compare_groups(replace(sample, points=points), FAST)
    assert [(pair.first, pair.second) for pair in found.pairs] == [(0, 1), (0, 2), (1, 2)]
    assert found.p_anywhere <= 0.05
    assert np.isnan(found.joint.t_squared)
    assert np.all(found.p_holm >= [pair.joint.p for pair in found.pairs])
    assert found.pairs[0].p_anywhere > 0.05
    assert max(found.pairs[1].p_anywhere, found.pairs[2].p_anywhere) <= 0.05
    assert set(np.unique(found.classification.predicted)) == {0, 1, 2}


def test_curves_in_space_are_compared_without_a_side():
    t = np.linspace(0, 1, 15)
    line = np.stack([t, t**2, t**3], axis=1)
    rng = np.random.default_rng(0)
    points = line + 0.05 * rng.normal(size=(12, 15, 3))
    sample = Sample(points, np.repeat([0, 1], 6), np.arange(12), np.empty((0, 3), dtype=np.int64))
    found = compare_groups(sample, FAST)
    assert found.normals is None
    assert found.pairs[0].distance is None
    assert found.p_anywhere == found.in_space.p_family.min()


def test_size_taken_as_covariate_removes_a_difference_of_size():
    rng = np.random.default_rng(5)
    sample = null_cohort(5, kind="single", n_subjects=30)
    factor = 1.0 + 0.08 * sample.labels + 0.03 * rng.standard_normal(30)
    points = sample.points[:1] * factor[:, None, None] + 0.05 * rng.standard_normal(sample.points.shape)
    grown = replace(sample, points=points)
    assert compare_groups(grown, FAST).joint.p <= 0.01
    adjusted = compare_groups(replace(grown, covariates=np.log(factor)[:, None]), FAST)
    assert adjusted.p_anywhere > 0.05
    assert adjusted.joint.p > 0.05


@pytest.mark.parametrize(
    ("change", "options", "words"),
    [
        ({"labels": np.zeros(29, dtype=np.int64)}, {}, "one group only"),
        ({"labels": np.r_[1, np.zeros(28, dtype=np.int64)]}, {}, "group 2 has 1 shape, at least 2 are needed"),
        ({}, {"n_modes": 60}, "60 modes cannot be tested jointly, these shapes allow 1 to 26"),
        ({"covariates": np.ones((29, 1))}, {"paired": True}, "covariates cannot be combined"),
        ({"subjects": np.arange(29)}, {"paired": True}, "0 subjects have shapes in both groups"),
        ({"points": np.ones((29, 63, 3))}, {}, "all shapes are the same"),
        ({"labels": np.arange(29) % 3}, {"paired": True}, "a paired comparison is of two groups, there are 3"),
        ({"covariates": np.random.default_rng(0).normal(size=(29, 26))}, {}, "29 shapes are too few for 2 groups"),
    ],
)
def test_what_cannot_be_compared_is_refused(change, options, words):
    with pytest.raises(ConfigError, match=words):
        compare_groups(replace(null_cohort(0), **change), replace(FAST, **options))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["single", "pairs", "mixed", "three", "paired", "covariate"])
def test_on_null_cohorts_the_level_is_kept(kind):
    """200 cohorts without a difference: rejections at 0.05 lie in their binomial interval for every test."""
    rejected = np.zeros(4)
    for seed in range(200):
        cohort = {"paired": "mixed", "covariate": "single"}.get(kind, kind)
        sample = null_cohort(seed, kind=cohort, n_subjects=24, covariate=kind == "covariate")
        found = compare_groups(sample, Options(n_permutations=199, n_shuffles=10, paired=kind == "paired"), seed)
        rejected += [
            found.joint.p <= 0.05,
            found.whole.p <= 0.05,
            found.p_anywhere <= 0.05,
            found.mode_tests.p_family.min() <= 0.05,
        ]
    low, high = stats.binom.interval(0.99, 200, 0.05)
    assert np.all((rejected >= low) & (rejected <= high)), rejected
