"""Time per iteration and peak memory against the number of shapes, 51 x 51 landmarks, 8 x 8 coefficients.

Every size runs in a process of its own, so that the peak belongs to it alone. The spline fits repeat after 30 shapes, moved a
little, since fitting is not what is measured.

    python -m benchmarks.growth                 10, 30, 100, 300, 1000 shapes
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import resource
import time
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.common import fresh, group_objective, head, median_time, moving_bumps
from ssmpipe.core.optim.interior import DescentOptions, minimize_interior
from ssmpipe.core.spline.evaluate import Spline
from ssmpipe.core.spline.surface import BSplineSurface


@dataclass(frozen=True)
class Row:
    """Seconds, and GB of peak memory."""

    n: int
    iteration: float
    gradient: float
    evaluation: float
    products: float
    eigen: float
    cholesky: float
    peak: float


def cohort(n: int) -> list[Spline]:
    base = moving_bumps(min(n, 30))
    rng = np.random.default_rng(0)
    out: list[Spline] = list(base)
    for k in range(len(base), n):
        s = base[k % len(base)]
        assert isinstance(s, BSplineSurface)
        moved = s.control_points + 0.05 * rng.normal(size=s.control_points.shape)
        out.append(BSplineSurface(s.degree, s.knots_u, s.knots_v, moved))
    return out


def measure(n: int, iterations: int) -> Row:
    with threadpool_limits(1):
        f = group_objective(cohort(n), barrier=10.0)
        x = f.start()
        f.value_and_gradient(x)
        begin = time.process_time()
        result = minimize_interior(f, x, DescentOptions(max_iterations=iterations, relative_decrease=0.0))
        iteration = (time.process_time() - begin) / max(1, result.n_iterations)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        x = result.value
        repeats = 5 if n <= 300 else 3

        def again() -> None:
            f.value_and_gradient(x)

        parameters = f.reparameterization.evaluate(f.coefficients(x))
        points = f.evaluate(x).points
        jet = f.stack.evaluate(parameters)
        flat = (points - points.mean(axis=0)).reshape(n, -1)
        gram = flat @ flat.T / (n - 1) / (flat.shape[1] / 3)
        shifted = gram + 1e-4 * np.eye(n)
        return Row(
            n,
            iteration,
            median_time(fresh(f, again), repeats),
            median_time(lambda: f.stack.evaluate(parameters, reuse=jet), repeats),
            median_time(lambda: (flat @ flat.T, gram @ flat), repeats),
            median_time(lambda: np.linalg.eigh(gram), repeats),
            median_time(lambda: (np.linalg.cholesky(shifted), np.linalg.inv(shifted)), repeats),
            peak,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shapes", type=int, nargs="+", default=[10, 30, 100, 300, 1000])
    parser.add_argument("--iterations", type=int, default=10, help="one preconditioner is built in ten")
    args = parser.parse_args()
    head(
        "Growth with the number of shapes; CPU seconds on one thread, preconditioner and line search within the iteration"
    )
    names = ("iteration", "gradient", "evaluation", "products", "eigen", "Cholesky")
    print(f"{'n_S':>5} " + " ".join(f"{name:>10}" for name in names) + f" {'peak GB':>8}")
    rows = []
    for n in args.shapes:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            row = pool.apply(measure, (n, args.iterations))
        values = (row.iteration, row.gradient, row.evaluation, row.products, row.eigen, row.cholesky)
        print(f"{n:>5} " + " ".join(f"{v:10.4f}" for v in values) + f" {row.peak:8.2f}", flush=True)
        rows.append(row)
    for a, b in itertools.pairwise(rows):
        slope = np.log(b.iteration / a.iteration) / np.log(b.n / a.n)
        share = (b.products + b.eigen) / b.gradient
        print(f"slope {a.n} to {b.n}: {slope:.2f}; products and eigenvalues are {share:.0%} of a gradient at {b.n}")


if __name__ == "__main__":
    main()
