"""What thousands of shapes could be done with instead, tried on a reduced landmark grid (17 x 17, 6 x 6 coefficients).

A core of the cohort is optimized as a group and all others join it one at a time, each against the fixed core; the description length
of everybody together is compared with that of one group optimization of all. And: the derivative of the description length from a few
modes found by block iteration, against all eigenvectors.

    python -m benchmarks.scale                          320 shapes, cores of 20, 40 and 80; modes at 1000 shapes
    python -m benchmarks.scale --shapes 160 --cores 20 40 --modes-at 500
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.common import head, inside, moving_bumps
from benchmarks.growth import cohort
from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.covariance import Spectrum, centred_spectrum
from ssmpipe.core.correspondence.newcomer import FixedCohort, bring_in
from ssmpipe.core.correspondence.objective import GroupObjective
from ssmpipe.core.correspondence.optimize import optimize_correspondence
from ssmpipe.core.correspondence.options import EngineOptions
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.correspondence.spectral import spectral_function
from ssmpipe.core.spline.evaluate import Spline, SplineStack

CUT = 1e-3


def options(grid: int, coefficients: int, n_shapes: int, *, balance: bool) -> EngineOptions:
    """Return the choices for a group of this size; ``balance``: barrier and prior weigh as in a group of twelve.

    Their weights are per shape, the description length is that of all: without the factor a larger group moves less.
    """
    factor, plain = (12 / n_shapes if balance else 1.0), EngineOptions()
    return EngineOptions(
        prior=factor * plain.prior,
        barriers=tuple(factor * b for b in plain.barriers),
        n_coefficients=(coefficients, coefficients),
        landmarks=(grid, grid),
        pose="keep",
        normalize="none",
        lambda_cut=CUT,
        landmark_blocks=1,
    )


def length(points: Floats) -> float:
    """Return the description length of (n_S, n_P, 3) points."""
    spectrum = centred_spectrum(points, np.full(points.shape[1], 1 / points.shape[1]))[1]
    return spectrum.value(spectral_function("description-length", CUT))


def group(splines: list[Spline], opts: EngineOptions) -> tuple[Floats, float, int]:
    """Return points, CPU seconds and iterations of one optimization of all."""
    begin = time.process_time()
    result = optimize_correspondence(splines, opts)
    return result.value.points, time.process_time() - begin, result.n_iterations


def joined(splines: list[Spline], m: int, opts: EngineOptions) -> tuple[Floats, float, float]:
    """Return points of all, CPU seconds of the core, and CPU seconds of one newcomer."""
    points, core, _ = group(splines[:m], opts)
    fixed = FixedCohort(points, opts.landmarks, closes=False, options=opts)
    begin = time.process_time()
    others = np.stack([bring_in(spline, fixed).value.points for spline in splines[m:]])
    return np.concatenate([points, others]), core, (time.process_time() - begin) / len(others)


def few_modes(n: int, opts: EngineOptions, extra: int = 10) -> None:
    """Compare the derivative in the landmarks from the largest modes only with that from all."""
    splines = cohort(n)
    stack, space = SplineStack(splines), Reparameterization(opts.n_coefficients, opts.landmarks)
    f = GroupObjective(stack, space, spectral_function("description-length", CUT), reference=0)
    evaluation = f.evaluate(inside(f))
    spectrum, weights = Spectrum(evaluation.spectrum.gram), evaluation.weights
    begin = time.process_time()
    values = spectrum.eigenvalues
    product = spectrum.slope_product(f.spectral)
    exact_time = time.process_time() - begin
    columns = evaluation.centred.reshape(n, -1)
    exact = product(columns)
    r = int((f.spectral.slope(values) != f.spectral.slope(values)[-1]).sum())
    print(f"\n{n} shapes, {r} of {n - 1} modes above the threshold")
    print(f"all eigenvectors of the Gram matrix: {exact_time:.3f} CPU s")
    root = np.sqrt(np.repeat(weights, evaluation.centred.shape[2]) / (n - 1))
    for rounds in (1, 3, 6):
        begin = time.process_time()
        scaled = columns * root
        basis = np.random.default_rng(0).normal(size=(n, r + extra))
        for _ in range(rounds):
            basis = np.linalg.qr(scaled @ (scaled.T @ basis))[0]
        small, turn = np.linalg.eigh((basis.T @ scaled) @ (scaled.T @ basis))
        found, vectors = small[::-1][:r], (basis @ turn)[:, ::-1][:, :r]
        seconds = time.process_time() - begin
        slopes, last = f.spectral.slope(found), f.spectral.slope(values)[-1]
        approximate = last * columns + vectors @ ((slopes - last)[:, None] * (vectors.T @ columns))
        error = np.linalg.norm(approximate - exact) / np.linalg.norm(exact)
        print(
            f"{r} + {extra} modes, {rounds} rounds of block iteration, no Gram matrix: {seconds:.3f} CPU s, "
            f"relative error of the derivative in the landmarks {error:.1e}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shapes", type=int, default=320)
    parser.add_argument("--cores", type=int, nargs="+", default=[20, 40, 80])
    parser.add_argument("--modes-at", type=int, default=1000)
    parser.add_argument("--grid", type=int, default=17)
    parser.add_argument("--coefficients", type=int, default=6)
    parser.add_argument("--balance", action="store_true", help="barrier and prior weigh as in a group of twelve")
    args = parser.parse_args()

    def opts_of(n: int) -> EngineOptions:
        return options(args.grid, args.coefficients, n, balance=args.balance)

    opts = opts_of(args.shapes)
    head(f"A core and newcomers against one group of {args.shapes}; CPU seconds on one thread")
    with threadpool_limits(1):
        splines = moving_bumps(args.shapes)
        uv = np.stack(np.meshgrid(*[np.linspace(0, 1, k) for k in opts.landmarks], indexing="ij"), axis=-1).reshape(
            -1, 2
        )
        start = SplineStack(splines).evaluate(np.repeat(uv[None], len(splines), axis=0)).points
        print(f"{'':<14} {'length':>9} {'core s':>9} {'s/newcomer':>11} {'all s':>9}")
        print(f"{'before':<14} {length(start):>9.3f}")
        for m in args.cores:
            points, core, each = joined(splines, m, opts_of(m))
            total = core + each * (len(splines) - m)
            print(f"core of {m:<6} {length(points):>9.3f} {core:>9.1f} {each:>11.3f} {total:>9.1f}", flush=True)
        points, seconds, n_iterations = group(splines, opts)
        print(
            f"{'one group':<14} {length(points):>9.3f} {seconds:>9.1f} {'':>11} {seconds:>9.1f}   {n_iterations} iterations"
        )
        few_modes(args.modes_at, opts)


if __name__ == "__main__":
    main()
