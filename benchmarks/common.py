"""What the benchmarks share: cohorts, a clock, and the description of the machine."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable
from importlib.util import find_spec
from statistics import median

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.objective import GroupObjective
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.correspondence.spectral import Objective, spectral_function
from ssmpipe.core.spline.evaluate import Evaluator, Spline, SplineStack
from ssmpipe.core.spline.fit import fit_surface
from ssmpipe.core.spline.surface import BSplineSurface

SIDE, WIDTH, N_CONTROL = 60.0, 8.0, 24
LAMBDA_CUT = 1e-4


def plane_bump(centre: tuple[float, float], height: float) -> BSplineSurface:
    t = np.linspace(0, SIDE, 4 * N_CONTROL)
    x, y = np.meshgrid(t, t, indexing="ij")
    z = height * np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / (2 * WIDTH**2))
    return fit_surface(np.stack([x, y, z], axis=-1), n_control=(N_CONTROL, N_CONTROL))


def moving_bumps(n: int, seed: int = 3) -> list[Spline]:
    """Return planes whose bump moves in x and y and changes height."""
    rng = np.random.default_rng(seed)
    return [plane_bump((rng.uniform(20, 40), rng.uniform(20, 40)), rng.uniform(15, 25)) for _ in range(n)]


def group_objective(
    splines: list[Spline],
    n_coefficients: tuple[int, ...] = (8, 8),
    grid: tuple[int, ...] = (51, 51),
    *,
    threads: int = 1,
    evaluator: Evaluator = "auto",
    objective: Objective = "description-length",
    barrier: float = 1.0,
) -> GroupObjective:
    """Return the discrete objective without prior; shape 0 is the reference."""
    return GroupObjective(
        SplineStack(splines, threads=threads, evaluator=evaluator),
        Reparameterization(n_coefficients, grid),
        spectral_function(objective, LAMBDA_CUT),
        reference=0,
        barrier=barrier,
    )


def inside(objective: GroupObjective, seed: int = 0) -> Floats:
    """Return feasible unknowns away from the identity."""
    rng = np.random.default_rng(seed)
    shift = rng.normal(size=objective.start().size)
    scale = 0.01
    while objective.smallest_jacobian(objective.start() + scale * shift) < 0.3:
        scale *= 0.5
    return objective.start() + scale * shift


def fresh(objective: GroupObjective, function: Callable[[], object]) -> Callable[[], object]:
    """Return ``function`` that cannot take the last evaluation for its own, as in a descent."""

    def run() -> object:
        if objective._last is not None:
            objective._last = (b"", objective._last[1])
        objective._local = objective._along = None
        return function()

    return run


def median_time(function: Callable[[], object], repeats: int = 7) -> float:
    """Return the median CPU time [s] of one thread after one unmeasured call; a busy machine does it little harm."""
    function()
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        function()
        times.append(time.process_time() - begin)
    return median(times)


def head(title: str) -> None:
    """Print the title and the machine."""
    evaluator = "numba" if find_spec("numba") else "numpy"
    versions = (
        f"Python {platform.python_version()}, numpy {np.__version__}, evaluator {evaluator} where not said otherwise"
    )
    print(
        f"{title}\n{time.strftime('%Y-%m-%d %H:%M')} UTC offset {time.strftime('%z')}, {platform.machine()}, {versions}\n"
    )
