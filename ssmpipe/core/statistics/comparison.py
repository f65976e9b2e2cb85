"""Everything that is asked of groups of corresponded shapes: are they different, in which modes, where, and by how much."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import ConfigError
from ssmpipe.core.model.pca import principal_components
from ssmpipe.core.statistics.covariates import Contrast, adjusted_means, group_contrast, pair_contrast
from ssmpipe.core.statistics.discriminant import Classification, Discriminant, cross_validate, discriminant
from ssmpipe.core.statistics.effect_size import cohen_d, effect_interval, hedges_g, mahalanobis
from ssmpipe.core.statistics.false_discovery import false_discovery_rate, holm
from ssmpipe.core.statistics.hotelling import parametric_p, permutation_test, t_squared
from ssmpipe.core.statistics.n_modes import ModeCount, modes_to_keep, parallel_analysis
from ssmpipe.core.statistics.paired import Pairs, pairs
from ssmpipe.core.statistics.permutation import Draws, exchanges, n_exchanges, sign_flips
from ssmpipe.core.statistics.pointwise import PointTests, outward_normals, point_tests, signed_distances


@dataclass(frozen=True, eq=False)
class Sample:
    """Corresponded shapes in groups.

    Parameters
    ----------
    points : (n, n_P, d) float64
        In one frame [mm].
    labels : (n,) int64
        Group of every shape, 0 to g - 1, all present.
    subjects : (n,) int64
        Number of the subject of every shape.
    faces : (n_F, 3) int64
        Empty for curves.
    closed : bool
        Whether a curve is closed.
    covariates : (n, c) float64, optional
    """

    points: Floats
    labels: Ints
    subjects: Ints
    faces: Ints
    closed: bool = False
    covariates: Floats | None = None

    @property
    def n_groups(self) -> int:
        """Number of groups."""
        return int(self.labels.max()) + 1

    def subjects_of(self, group: int) -> int:
        """Return how many subjects have a shape in a group."""
        return len(np.unique(self.subjects[self.labels == group]))


@dataclass(frozen=True)
class Options:
    """How groups are compared.

    Parameters
    ----------
    n_modes : int, optional
        Modes of the joint test; by parallel analysis and share of variance when None.
    n_permutations : int
    paired : bool
        Whether the two groups are compared inside of subjects.
    n_shuffles : int
        Of the parallel analysis.
    """

    n_modes: int | None = None
    n_permutations: int = 10_000
    paired: bool = False
    n_shuffles: int = 100


@dataclass(frozen=True)
class JointTest:
    """A test of several dimensions at once.

    Parameters
    ----------
    n_dimensions : int
    trace : float
        Pillai's trace; for whole shapes the share of all variation that lies between the groups.
    t_squared : float
        Hotelling's T2; NaN unless two groups are compared in modes.
    p : float
        By permutation.
    p_parametric : float
        By the F distribution, for independent normal shapes; NaN for whole shapes.
    """

    n_dimensions: int
    trace: float
    t_squared: float
    p: float
    p_parametric: float


@dataclass(frozen=True, eq=False)
class ModeTests:
    """Tests of each kept mode.

    Parameters
    ----------
    means : (g, k) float64
        Of the groups [standard deviations of the mode].
    p, q, p_family : (k,) float64
        Alone, by Benjamini-Hochberg, by max-T.
    p_joint : (k,) float64
        Of the joint test in the modes up to this one: how much hangs on the number of modes.
    """

    means: Floats
    p: Floats
    q: Floats
    p_family: Floats
    p_joint: Floats


@dataclass(frozen=True, eq=False)
class Effects:
    """Hedges' g of each kept mode with its 95 % interval, (k,) each."""

    g: Floats
    low: Floats
    high: Floats


@dataclass(frozen=True, eq=False)
class Pair:
    """Two groups compared: the second less the first.

    Parameters
    ----------
    first, second : int
        Numbers of the groups.
    joint, whole : JointTest
        In the kept modes, and of all variation.
    modes : ModeTests
    effects : Effects
    mahalanobis : float
        Between the means in the kept modes [standard deviations inside of the groups].
    displacement : (n_P, d) float64
        Of the (adjusted) means [mm].
    distance : (n_P,) float64, optional
        Its part along the normals of the mean, positive outward [mm]; None for curves in space.
    effect : (n_P,) float64, optional
        ``distance`` in standard deviations inside of the groups (Cohen's d).
    along_normal : PointTests, optional
        Tests of ``distance``.
    in_space : PointTests
        Hotelling's T2 of the displacement at every point.
    p_anywhere : float
        Chance that some point anywhere differs as much along the normal (max-T over all points): a test of local differences.
    discriminant : Discriminant
    classification : Classification
    n_rearrangements : int
        Different labellings (or signs) that there are.
    pairs : Pairs, optional
        Of a paired comparison.
    """

    first: int
    second: int
    joint: JointTest
    whole: JointTest
    modes: ModeTests
    effects: Effects
    mahalanobis: float
    displacement: Floats
    distance: Floats | None
    effect: Floats | None
    along_normal: PointTests | None
    in_space: PointTests
    p_anywhere: float
    discriminant: Discriminant
    classification: Classification
    n_rearrangements: int
    pairs: Pairs | None


@dataclass(frozen=True, eq=False)
class Comparison:
    """All groups compared.

    Parameters
    ----------
    mean : (n_P, d) float64
        Of all shapes [mm].
    normals : (n_P, d) float64, optional
    group_means : (g, n_P, d) float64
        At the average covariates [mm].
    modes : (n_modes, n_P, d) float64
    variances : (n_modes,) float64
    scores : (n, n_modes) float64
        Standard deviations of the mode.
    count : ModeCount
    joint, whole : JointTest
        All groups at once.
    mode_tests : ModeTests
    along_normal : PointTests, optional
    in_space : PointTests
    p_anywhere : float
    pairs : tuple of Pair
    p_holm : (n_pairs,) float64
        Of the joint tests of the pairs, for all pairs together.
    classification : Classification
        Into all groups.
    n_rearrangements : int
    """

    mean: Floats
    normals: Floats | None
    group_means: Floats
    modes: Floats
    variances: Floats
    scores: Floats
    count: ModeCount
    joint: JointTest
    whole: JointTest
    mode_tests: ModeTests
    along_normal: PointTests | None
    in_space: PointTests
    p_anywhere: float
    pairs: tuple[Pair, ...]
    p_holm: Floats
    classification: Classification
    n_rearrangements: int


@dataclass(frozen=True, eq=False)
class _Design:
    """What is rearranged, against what, how often."""

    contrast: Contrast
    draws: Draws
    matched: Pairs | None
    n_rearrangements: int

    def tested(self, values: Floats) -> Floats:
        return values if self.matched is None else self.matched.differences(values)


def compare_groups(sample: Sample, options: Options, seed: int = 0) -> Comparison:
    """Compare groups of corresponded shapes, all at once and two by two.

    The modes, their number and the normals are those of all shapes together, whatever their group, so that exchanging labels
    changes nothing but the labels: without covariates every permutation p value is exact.

    Parameters
    ----------
    sample : Sample
    options : Options
    seed : int
        Of the permutations, of the shuffles and of the folds; the same seed gives the same numbers.

    Raises
    ------
    ConfigError
        If there are fewer than two groups, too few shapes, or more modes are asked for than the sample can bear.
    """
    _check(sample, options)
    mean, modes, variances, scores = principal_components(sample.points)
    if len(variances) == 0:
        raise ConfigError("all shapes are the same: there is nothing to compare")
    components = scores * np.sqrt(variances)
    normals = None
    if len(sample.faces) or mean.shape[1] == 2:
        normals = outward_normals(mean, sample.faces, closed=sample.closed)
    along = None if normals is None else signed_distances(sample.points, mean, normals)
    design = _design(sample, options, np.random.default_rng([seed, 0]))
    thresholds = parallel_analysis(
        sample.points.reshape(len(sample.points), -1), np.random.default_rng([seed, 1]), options.n_shuffles
    )
    count = modes_to_keep(variances, thresholds, design.contrast.degrees_of_error)
    if options.n_modes is not None:
        count = replace(count, kept=_possible(options.n_modes, len(variances), design.contrast.degrees_of_error))
    data = _Data(components, scores, along)
    found = []
    for number, (first, second) in enumerate(combinations(range(sample.n_groups), 2)):
        rows = (sample.labels == first) | (sample.labels == second)
        part = _part(sample, rows, second)
        plan = design if sample.n_groups == 2 else _design(part, options, np.random.default_rng([seed, 2, number]))
        kept = count.kept
        if sample.n_groups > 2:
            degrees = plan.contrast.degrees_of_error
            kept = min(kept, max(1, degrees // 3)) if options.n_modes is None else _possible(kept, kept, degrees)
        rng = np.random.default_rng([seed, 3, number])
        found.append(_pair(part, data.rows(rows), plan, (first, second), kept, rng))
    joint, whole, mode_tests = _joint_tests(sample, data, design, count.kept)
    two = sample.n_groups == 2
    along_normal = found[0].along_normal if two else _maybe_points(along, design)
    in_space = found[0].in_space if two else _points(sample.points, design)
    return Comparison(
        mean=mean,
        normals=normals,
        group_means=adjusted_means(sample.points, sample.labels, sample.covariates)[0],
        modes=modes,
        variances=variances,
        scores=scores,
        count=count,
        joint=joint,
        whole=whole,
        mode_tests=mode_tests,
        along_normal=along_normal,
        in_space=in_space,
        p_anywhere=float((along_normal or in_space).p_family.min()),
        pairs=tuple(found),
        p_holm=holm(np.array([pair.joint.p for pair in found])),
        classification=found[0].classification
        if two
        else cross_validate(
            components,
            sample.labels,
            sample.subjects,
            count.kept,
            np.random.default_rng([seed, 4]),
            covariates=sample.covariates,
        ),
        n_rearrangements=design.n_rearrangements,
    )


@dataclass(frozen=True, eq=False)
class _Data:
    components: Floats
    scores: Floats
    along: Floats | None

    def rows(self, chosen: Floats) -> _Data:
        along = None if self.along is None else self.along[chosen]
        return _Data(self.components[chosen], self.scores[chosen], along)


def _check(sample: Sample, options: Options) -> None:
    counts = np.bincount(sample.labels)
    if len(counts) < 2:
        raise ConfigError("there is one group only", "choose a column with at least two values")
    if counts.min() < 2:
        raise ConfigError(
            f"group {int(counts.argmin()) + 1} has {counts.min()} shape, at least 2 are needed",
            "leave this group out with --groups",
        )
    if options.paired and len(counts) != 2:
        raise ConfigError(
            f"a paired comparison is of two groups, there are {len(counts)}", "choose two with --groups A,B"
        )
    if options.paired and sample.covariates is not None:
        raise ConfigError(
            "covariates cannot be combined with a paired comparison",
            "leave --covariates out: what is the same for both shapes of a subject has no influence on their difference",
        )


def _possible(n_modes: int, available: int, degrees_of_error: int) -> int:
    most = min(available, degrees_of_error - 1)
    if not 1 <= n_modes <= most:
        raise ConfigError(
            f"{n_modes} modes cannot be tested jointly, these shapes allow 1 to {most}",
            "give fewer --modes, or leave it at auto",
        )
    return n_modes


def _part(sample: Sample, rows: Floats, second: int) -> Sample:
    covariates = None if sample.covariates is None else sample.covariates[rows]
    labels = (sample.labels[rows] == second).astype(np.int64)
    return replace(
        sample, points=sample.points[rows], labels=labels, subjects=sample.subjects[rows], covariates=covariates
    )


def _design(sample: Sample, options: Options, rng: np.random.Generator) -> _Design:
    if options.paired:
        matched = pairs(sample.labels, sample.subjects)
        n = len(matched.subjects)
        if n < 3:
            raise ConfigError(
                f"{n} subjects have shapes in both groups, a paired comparison needs at least 3",
                "check the column given to --paired, or compare the groups without it",
            )
        return _Design(pair_contrast(n), sign_flips(n, options.n_permutations, rng), matched, 2**n)
    contrast = group_contrast(sample.labels, sample.covariates)
    if contrast.degrees_of_error < 2:
        raise ConfigError(
            f"{len(sample.labels)} shapes are too few for {sample.n_groups} groups and {contrast.nuisance.shape[1] - 1} covariate columns",
            "use more shapes or fewer covariates",
        )
    draws = exchanges(sample.subjects, options.n_permutations, rng)
    return _Design(contrast, draws, None, n_exchanges(sample.labels, sample.subjects))


def _joint_tests(sample: Sample, data: _Data, design: _Design, kept: int) -> tuple[JointTest, JointTest, ModeTests]:
    contrast, draws = design.contrast, design.draws
    values = design.tested(data.components)
    n_columns, degrees = contrast.tested.shape[1], contrast.degrees_of_error
    of_modes = permutation_test(values[:, None, :kept], contrast, draws)
    trace = float(of_modes.statistic[0])
    joint = JointTest(
        kept,
        trace,
        t_squared(trace, degrees) if n_columns == 1 else float("nan"),
        float(of_modes.p[0]),
        parametric_p(trace, kept, n_columns, degrees),
    )
    of_all = permutation_test(values[:, None], contrast, draws, whole=True)
    whole = JointTest(values.shape[1], float(of_all.statistic[0]), float("nan"), float(of_all.p[0]), float("nan"))
    each = permutation_test(values[:, :kept, None], contrast, draws)
    p = np.nan_to_num(each.p, nan=1.0)
    if design.matched is None:
        means = adjusted_means(data.scores[:, :kept], sample.labels, sample.covariates)[0]
    else:
        paired_rows = np.isin(sample.subjects, design.matched.subjects)
        means = adjusted_means(data.scores[paired_rows, :kept], sample.labels[paired_rows])[0]
    up_to = [float(permutation_test(values[:, None, :k], contrast, draws).p[0]) for k in range(1, kept)]
    tests = ModeTests(
        means, p, false_discovery_rate(p), np.nan_to_num(each.p_family, nan=1.0), np.array([*up_to, joint.p])
    )
    return joint, whole, tests


def _points(values: Floats, design: _Design) -> PointTests:
    return point_tests(design.tested(values), design.contrast, design.draws)


def _maybe_points(values: Floats | None, design: _Design) -> PointTests | None:
    return None if values is None else _points(values, design)


def _gap(values: Floats, sample: Sample, design: _Design) -> tuple[Floats, Floats]:
    """Return the difference of the means, and the rows that tell how sure it is."""
    if design.matched is not None:
        differences = design.tested(values)
        mean = differences.mean(axis=0)
        return mean, differences - mean
    means, residuals = adjusted_means(values, sample.labels, sample.covariates)
    return means[1] - means[0], residuals


def _pair(
    sample: Sample, data: _Data, design: _Design, numbers: tuple[int, int], kept: int, rng: np.random.Generator
) -> Pair:
    degrees = design.contrast.degrees_of_error
    joint, whole, tests = _joint_tests(sample, data, design, kept)
    gap, residuals = _gap(data.components[:, :kept], sample, design)
    g = hedges_g(cohen_d(gap, residuals, degrees), degrees)
    if design.matched is None:
        low, high = effect_interval(g, sample.subjects_of(0), sample.subjects_of(1))
    else:
        low, high = effect_interval(g, len(design.matched.subjects), None)
    distance = effect = None
    if data.along is not None:
        distance, spread = _gap(data.along, sample, design)
        effect = np.nan_to_num(cohen_d(distance, spread, degrees))
    degrees_of_groups = len(sample.labels) - 2 - (0 if sample.covariates is None else sample.covariates.shape[1])
    along_normal, in_space = _maybe_points(data.along, design), _points(sample.points, design)
    return Pair(
        first=numbers[0],
        second=numbers[1],
        joint=joint,
        whole=whole,
        modes=tests,
        effects=Effects(g, low, high),
        mahalanobis=mahalanobis(gap, residuals, degrees),
        displacement=_gap(sample.points, sample, design)[0],
        distance=distance,
        effect=effect,
        along_normal=along_normal,
        in_space=in_space,
        p_anywhere=float((along_normal or in_space).p_family.min()),
        discriminant=discriminant(
            sample.points, data.components[:, :kept], sample.labels, degrees_of_groups, sample.covariates
        ),
        classification=cross_validate(
            data.components, sample.labels, sample.subjects, kept, rng, covariates=sample.covariates
        ),
        n_rearrangements=design.n_rearrangements,
        pairs=design.matched,
    )
