"""Rejection rates of `ssmpipe compare` on cohorts without any difference: 200 of each kind, level 0.05."""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from scipy import stats

from ssmpipe.core.statistics.comparison import Options, compare_groups
from tests.support.groups import null_cohort

KINDS = {
    "single": "one shape of each of 24 subjects",
    "pairs": "36 shapes of 24 subjects, groups differ between subjects",
    "mixed": "36 shapes of 24 subjects, groups differ inside of subjects",
    "three": "three groups",
    "paired": "the 12 subjects of 'mixed' with both, paired",
    "covariate": "a covariate that goes with the group, removed",
    "ignored": "'pairs' as if all shapes were independent: what goes wrong",
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


if __name__ == "__main__":
    main()
