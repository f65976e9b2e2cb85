"""One gradient of 34 shapes over its floor: the bare evaluation of S, S_u, S_v at the same points and the two Gram products.

python -m benchmarks.gradient_cost
"""

from __future__ import annotations

import argparse

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.common import fresh, group_objective, head, inside, median_time, moving_bumps
from ssmpipe.core.spline import compiled
from ssmpipe.core.spline.evaluate import Evaluator


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shapes", type=int, default=34)
    parser.add_argument("--repeats", type=int, default=15)
    args = parser.parse_args()
    head(
        f"Cost of one gradient, {args.shapes} shapes, 51 x 51 landmarks, 8 x 8 coefficients, medians of {args.repeats} [ms]"
    )
    splines = moving_bumps(args.shapes)
    evaluators: list[Evaluator] = ["numpy", "numba"] if compiled.available() else ["numpy"]
    names = ("evaluation", "products", "floor", "gradient", "/ floor", "with barrier", "/ floor")
    print(f"{'evaluator':10} " + " ".join(f"{name:>12}" for name in names))
    for evaluator in evaluators:
        f = group_objective(splines, evaluator=evaluator)
        x = inside(f)
        parameters = f.reparameterization.evaluate(f.coefficients(x))
        jet = f.stack.evaluate(parameters)
        points = jet.points.copy()
        flat = (points - points.mean(axis=0)).reshape(len(points), -1)
        gram = flat @ flat.T
        evaluation = median_time(lambda f=f, p=parameters, j=jet: f.stack.evaluate(p, reuse=j), args.repeats)
        products = median_time(lambda a=flat, g=gram: (a @ a.T, g @ a), args.repeats)
        gradient = median_time(fresh(f, lambda f=f, x=x: f.spectral_gradient(x)), args.repeats)
        whole = median_time(fresh(f, lambda f=f, x=x: f.value_and_gradient(x)), args.repeats)
        floor = evaluation + products
        row = (
            1e3 * evaluation,
            1e3 * products,
            1e3 * floor,
            1e3 * gradient,
            gradient / floor,
            1e3 * whole,
            whole / floor,
        )
        print(f"{evaluator:10} " + " ".join(f"{value:12.2f}" for value in row))
        assert np.isfinite(gram).all()


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
