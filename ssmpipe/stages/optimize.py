"""Find dense correspondence across the cohort by B-spline reparameterization of minimal description length."""

from __future__ import annotations

import time
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from ssmpipe.contract import Context, Port, Stage, StageConfig, Table
from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.correspondence import Correspondence
from ssmpipe.core.correspondence.optimize import EngineOptions, Optimum, optimize_correspondence
from ssmpipe.core.errors import ConfigError, FoldoverError
from ssmpipe.core.mesh.grid import grid_faces
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.spline.surface import BSplineSurface

_DEFAULT = EngineOptions()


class Config(StageConfig):
    """Options of ``optimize``."""

    n_coefficients: Annotated[
        tuple[int, int], Field(description="B-spline coefficients of every reparameterization, per direction.")
    ] = _DEFAULT.n_coefficients
    landmarks: Annotated[tuple[int, int], Field(description="Landmark grid of the covariance, per direction.")] = (
        _DEFAULT.landmarks
    )
    degree: Annotated[int, Field(ge=2, le=5, description="Degree of the reparameterization.")] = _DEFAULT.degree
    boundary: Annotated[
        Literal["fixed", "sliding"],
        Field(description="fixed: boundary points stay; sliding: they may slide along their edge, corners stay."),
    ] = _DEFAULT.boundary
    covariance: Annotated[
        Literal["discrete", "II"],
        Field(description="Landmark weights: discrete: equal; II: area on the mean shape, with exact gradient."),
    ] = _DEFAULT.covariance
    lambda_cut: Annotated[
        float | Literal["auto"],
        Field(description="Variance below which a mode counts as noise [mm^2]; auto: (RMS radius / 1000)^2."),
    ] = "auto"
    pose: Annotated[
        Literal["refined", "procrustes", "keep"],
        Field(
            description="Rigid poses. keep: as aligned; procrustes: refined once before, from the initial correspondence; "
            "refined: refined from the optimized correspondence, pose_rounds times."
        ),
    ] = _DEFAULT.pose
    pose_rounds: Annotated[int, Field(ge=0, description="Refinements of the poses when pose is refined.")] = (
        _DEFAULT.pose_rounds
    )
    remove_size: Annotated[bool, Field(description="Remove sizes inside the objective only; results keep them.")] = (
        _DEFAULT.remove_size
    )
    prior: Annotated[
        float, Field(ge=0, description="Weight of the bending energy of every reparameterization [nat].")
    ] = _DEFAULT.prior
    barriers: Annotated[
        tuple[float, ...],
        Field(min_length=1, description="Decreasing weights of the barrier on det dD/du, one round each [nat]."),
    ] = _DEFAULT.barriers
    floor: Annotated[float, Field(ge=0, lt=1, description="Lower bound that det dD/du is kept above [-].")] = (
        _DEFAULT.floor
    )
    reference: Annotated[
        str, Field(description="Shape that is not reparameterized: nearest-to-mean, none, or a shape id.")
    ] = "nearest-to-mean"
    max_iterations: Annotated[int, Field(ge=1, description="Iterations per round.")] = _DEFAULT.max_iterations
    relative_decrease: Annotated[
        float,
        Field(gt=0, description="A round ends when the objective falls by less than this share twice in a row [-]."),
    ] = _DEFAULT.relative_decrease


def run(
    *, surface: dict[str, BSplineSurface], transform: dict[str, Floats], cfg: Config, ctx: Context
) -> dict[str, Any]:
    """Optimize, prove, and carry the result back to the scans."""
    ids = tuple(sorted(surface))
    options = EngineOptions(
        **cfg.model_dump(exclude={"lambda_cut", "reference"}),
        lambda_cut=None if cfg.lambda_cut == "auto" else cfg.lambda_cut,
        reference=_reference(cfg.reference, ids),
    )
    start = time.perf_counter()
    elapsed: list[float] = []

    def record(row: dict[str, float]) -> None:
        elapsed.append(time.perf_counter() - start)
        text = f"description length {row['description_length']:.3f}, smallest Jacobian bound {row['min_jacobian']:.3f}"
        ctx.progress(int(row["iteration"]), _expected(cfg), text)

    result = optimize_correspondence([surface[i] for i in ids], options, record=record)
    optimum = result.value
    if result.status == "out-of-iterations":
        ctx.warn(
            f"the last round stopped at {cfg.max_iterations} iterations before it settled; raise optimize.max_iterations"
        )
    correspondence = _correspondence(optimum, ids, transform, cfg)
    certificate = _certificate(optimum, ids)
    before, after = optimum.description_length
    for name, value in (
        ("description_length_before", before),
        ("description_length_after", after),
        ("lambda_cut_mm2", optimum.lambda_cut),
        ("n_iterations", result.n_iterations),
        ("n_evaluations", result.n_evaluations),
        ("smallest_jacobian_bound", min(c.lower_bound for c in optimum.certificates)),
        ("reference", ids[optimum.reference] if optimum.reference >= 0 else "none"),
    ):
        ctx.metric(name, value)
    refuted = [i for i, c in zip(ids, optimum.certificates, strict=True) if c.verdict != "proved"]
    if refuted:
        raise FoldoverError(
            f"the reparameterization of {', '.join(refuted)} is not proved one-to-one",
            "raise the last of optimize.barriers",
        )
    history = {key: values.tolist() for key, values in result.history.items()}
    columns = {"iteration": [int(k) for k in history.pop("iteration")], "elapsed_s": elapsed, **history}
    corresponded = {}
    for i, points, matrix in zip(ids, correspondence.points_scan, correspondence.transform, strict=True):
        mirrored = np.linalg.det(matrix[:3, :3]) < 0
        faces = correspondence.faces[:, ::-1] if mirrored else correspondence.faces
        corresponded[i] = TriMesh(points, faces)
    return {
        "correspondence": correspondence,
        "certificate": certificate,
        "history": Table(columns, "description_length in nat; elapsed_s is a timing and differs from run to run"),
        "corresponded": corresponded,
    }


def _expected(cfg: Config) -> int:
    """Return a rough number of iterations, for the progress bar only."""
    return 25 * (len(cfg.barriers) + (cfg.pose_rounds if cfg.pose == "refined" else 0))


def _reference(choice: str, ids: tuple[str, ...]) -> Any:
    if choice in ("nearest-to-mean", "none"):
        return choice
    if choice not in ids:
        raise ConfigError(f"optimize.reference: there is no shape '{choice}' among {', '.join(ids)}", "nearest-to-mean")
    return ids.index(choice)


def _correspondence(
    optimum: Optimum, ids: tuple[str, ...], transform: dict[str, Floats], cfg: Config
) -> Correspondence:
    matrices = np.repeat(np.eye(4)[None], len(ids), axis=0)
    matrices[:, :3, :3] = optimum.alignment.rotation
    matrices[:, :3, 3] = optimum.alignment.translation
    matrices = matrices @ np.stack([transform[i] for i in ids])
    back = np.linalg.inv(matrices)

    def to_scan(points: Floats) -> Floats:
        return points @ np.swapaxes(back[:, :3, :3], 1, 2) + back[:, None, :3, 3]

    return Correspondence(
        ids=ids,
        points=optimum.points,
        points_scan=to_scan(optimum.points),
        initial_points=optimum.initial_points,
        initial_points_scan=to_scan(optimum.initial_points),
        transform=matrices,
        scale=optimum.alignment.scale,
        parameters=optimum.parameters,
        grid=cfg.landmarks,
        faces=grid_faces(*cfg.landmarks),
        topology="disk",
        reference=optimum.reference,
        description_length=np.array(optimum.description_length),
        lambda_cut=optimum.lambda_cut,
        eigenvalues_initial=optimum.eigenvalues_initial,
        eigenvalues=optimum.eigenvalues,
        coefficients=optimum.coefficients,
    )


def _certificate(optimum: Optimum, ids: tuple[str, ...]) -> dict[str, Any]:
    method = "smallest Bernstein coefficient of det dD/du over the unit square, bisected until proved or refuted, rounding included"
    return {
        "quantity": "lower bound of det dD/du over the whole parameter domain",
        "method": method,
        "all_proved": all(c.verdict == "proved" for c in optimum.certificates),
        "shapes": {
            i: {
                "lower_bound": c.lower_bound,
                "smallest_value_seen": c.upper_bound_of_minimum,
                "status": c.verdict,
                "subdivisions": c.n_subdivisions,
                "method": method,
            }
            for i, c in zip(ids, optimum.certificates, strict=True)
        },
    }


STAGE = Stage(
    name="optimize",
    scope="cohort",
    version=1,
    config=Config,
    run=run,
    inputs=(Port("surface", "surface"), Port("transform", "transform")),
    outputs=(
        Port("correspondence", "correspondence"),
        Port("certificate", "json"),
        Port("history", "table", volatile=True),
        Port("corresponded", "meshes"),
    ),
    methods="Correspondence was found by B-spline reparameterization of all shapes at once ({n_coefficients} coefficients each), "
    "minimizing the description length of the covariance of {landmarks} landmarks with adjoint gradients; every "
    "reparameterization was proved to be a diffeomorphism by Bernstein bounds of its Jacobian.",
    cites=("li2015", "thodberg2003", "davies2002"),
)
