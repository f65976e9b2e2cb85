"""What the weight of normals in the description length does, on every finished run that is given; write a page.

    python docs/make_normals.py --families FOLDER --synthetic FOLDER --femora DATA --distal RUN --proximal RUN

``--families`` was filled by make_families.py, ``--synthetic`` by make_synthetic_cohorts.py; RUN are outputs of
``configs/femur_distal.yaml`` and ``configs/femur_proximal.yaml`` on DATA (``scans/``, ``cohort.csv``, ``landmarks.json``). Each row
takes the splines and all other options of its run.

    python docs/make_normals.py --femora DATA --distal RUN --price

writes nothing; it prints the error of each bone left out of the group and brought in afterwards, and of half a bone completed from the
other half by the posterior of the model of the others, with and without normals.

    python docs/make_normals.py --families FOLDER ... --starts

writes nothing either; it prints error and description length of both starts of the optimization, with normals, for every cohort: a
table of ``families.md``.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from make_families import errors_of  # noqa: E402
from make_rims import placed  # noqa: E402
from study_cohorts import fitted  # noqa: E402

from ssmpipe.core.correspondence.choices import boundary_of, start_of  # noqa: E402
from ssmpipe.core.correspondence.newcomer import FixedCohort, bring_in  # noqa: E402
from ssmpipe.core.correspondence.normals import DEFAULT_NORMALS  # noqa: E402
from ssmpipe.core.correspondence.optimize import optimize_correspondence  # noqa: E402
from ssmpipe.core.correspondence.optimum import Optimum  # noqa: E402
from ssmpipe.core.correspondence.options import EngineOptions  # noqa: E402
from ssmpipe.core.evaluation.landmark_transfer import landmark_transfer  # noqa: E402
from ssmpipe.core.evaluation.measures import generalization, specificity  # noqa: E402
from ssmpipe.core.mesh.distance import point_to_mesh  # noqa: E402
from ssmpipe.core.mesh.grid import grid_faces  # noqa: E402
from ssmpipe.core.mesh.trimesh import TriMesh  # noqa: E402
from ssmpipe.core.model.pca import principal_components  # noqa: E402
from ssmpipe.core.spline.evaluate import Spline  # noqa: E402
from ssmpipe.core.spline.poles import surface_topology  # noqa: E402
from ssmpipe.io.landmarks import read_landmarks  # noqa: E402

WEIGHTS = (0.0, 0.3, 0.5, 0.8, 1.1, 1.6)
Error = Callable[..., np.ndarray]
"""Of a result, its points and faces; landmarks also of one shape to and from which they are carried."""


def options_of(run: Path, splines: list[Spline]) -> EngineOptions:
    """Return the options of a run, in the pose of the splines."""
    given = json.loads((run / "cohort" / "optimize" / "manifest.json").read_text())["config"]
    known = {k: tuple(v) if isinstance(v, list) else v for k, v in given.items()}
    kept = {k: v for k, v in known.items() if k in EngineOptions.__dataclass_fields__}
    topology = surface_topology(splines[0])
    kept["boundary"] = boundary_of(given["boundary"], topology)
    kept["start"] = start_of(
        given["start"], topology=topology, normalize=given["normalize"], guided=False, reference=given["reference"]
    )
    for name in ("lambda_cut", "landmark_blocks"):
        kept[name] = None if given[name] == "auto" else given[name]
    return EngineOptions(**kept)


def against(truth: np.ndarray) -> Error:
    """Return the errors at true places (n_S, n_T, 3) in the frame of the splines."""

    def error(found: Optimum, points: np.ndarray, faces: np.ndarray) -> np.ndarray:
        there = truth @ np.swapaxes(found.alignment.rotation, 1, 2) + found.alignment.translation[:, None]
        return errors_of(points, faces, there)[1]

    return error


def against_experts(ids: list[str], marks: dict[str, dict[str, np.ndarray]]) -> Error:
    """Return the errors at landmarks in the frame of the splines."""

    def error(found: Optimum, points: np.ndarray, faces: np.ndarray, to_and_from: int | None = None) -> np.ndarray:
        poses = zip(ids, found.alignment.rotation, found.alignment.translation, strict=True)
        moved = {i: {n: r @ p + t for n, p in marks[i].items()} for i, r, t in poses}
        transfers = landmark_transfer(points, faces, ids, moved, max_distance=8.0)
        if to_and_from is None:
            every = np.concatenate([t.off_diagonal() for t in transfers])
        else:
            own = ids[to_and_from]
            pairs = [(t.errors, t.ids.index(own)) for t in transfers if own in t.ids]
            every = np.concatenate([np.r_[np.delete(e[k], k), np.delete(e[:, k], k)] for e, k in pairs])
        return np.asarray(every[np.isfinite(every)])

    return error


def compared(name: str, run: Path, make: Callable[[list[str], np.ndarray], Error]) -> tuple[str, str]:
    """Return the rows of both tables."""
    ids, splines, matrices = fitted(run)
    options, error = options_of(run, splines), make(ids, matrices)
    topology = surface_topology(splines[0])
    wraps, last = topology != "disk", topology in ("cone", "closed")
    faces = grid_faces(*options.landmarks, periodic_u=wraps, pole_start=topology == "closed", pole_end=last)
    cells, quality = [], []
    for weight in WEIGHTS:
        found = optimize_correspondence(splines, replace(options, normals=weight)).value
        assert all(c.verdict == "proved" for c in found.certificates)
        if not cells:
            cells.append(float(error(found, found.initial_points, faces).mean()))
        cells.append(float(error(found, found.points, faces).mean()))
        if weight in (0.0, 0.8):
            mean_error = generalization(found.points, 3)[0][2]
            distance = specificity(found.points, 3, n_samples=1000, rng=np.random.default_rng(0))[0][2]
            quality.append(f"{mean_error:.2f} / {distance:.2f}")
        print(name, weight, f"{cells[-1]:.3f}", flush=True)
    row = f"| {name} | " + " | ".join(f"{c:.2f}" for c in cells) + " |"
    return row, f"| {name} | " + " | ".join(quality) + " |"


def left_out(splines: list[Spline], options: EngineOptions, error: Error) -> float:
    """Return the mean error of what is carried to and from each disk, left out of the group and brought in afterwards [mm]."""
    n, faces, found = len(splines), grid_faces(*options.landmarks), []
    for i in range(n):
        rest = [k for k in range(n) if k != i]
        group = optimize_correspondence([splines[k] for k in rest], options).value
        known = replace(options, lambda_cut=group.lambda_cut)
        seen = {"normals": group.normals, "normal_scale": group.normal_scale}
        fixed = FixedCohort(group.points, options.landmarks, closes=False, options=known, **seen)
        new = bring_in(splines[i], fixed).value
        points = np.insert(group.points, i, new.points, axis=0)
        rotation = np.insert(group.alignment.rotation, i, new.matrix[:3, :3], axis=0)
        translation = np.insert(group.alignment.translation, i, new.matrix[:3, 3], axis=0)
        posed = replace(group, alignment=replace(group.alignment, rotation=rotation, translation=translation))
        found.append(error(posed, points, faces, i).mean())
    return float(np.mean(found))


def completed(points: np.ndarray, faces: np.ndarray, sigma: float = 1.0) -> tuple[float, float, float]:
    """Return the distance of hidden halves to the true surface: one half, the other half, and of the mean shape [mm, RMS]."""
    cells: dict[str, list[float]] = {"right": [], "left": [], "mean": []}
    for i in range(len(points)):
        rest = np.delete(points, i, axis=0)
        mean, modes, variances, _ = principal_components(rest)
        basis = (modes * np.sqrt(variances)[:, None, None]).reshape(len(variances), -1).T
        surface, middle = TriMesh(points[i], faces), np.median(mean[:, 0])
        for side, hidden in (("right", mean[:, 0] > middle), ("left", mean[:, 0] < middle)):
            seen = basis[np.repeat(~hidden, 3)]
            normal = seen.T @ seen + sigma**2 * np.eye(len(variances))
            score = np.linalg.solve(normal, seen.T @ (points[i] - mean)[~hidden].ravel())
            for name, guess in ((side, mean + (basis @ score).reshape(-1, 3)), ("mean", mean)):
                cells[name].append(float(np.sqrt((point_to_mesh(guess[hidden], surface)[0] ** 2).mean())))
    right, left, mean_shape = (float(np.mean(c)) for c in cells.values())
    return right, left, mean_shape


def print_price(run: Path, marks: Callable[[list[str], np.ndarray], Error]) -> None:
    """Print what left-out and half bones cost with and without normals."""
    ids, splines, matrices = fitted(run)
    options, error = options_of(run, splines), marks(ids, matrices)
    faces = grid_faces(*options.landmarks)
    for weight in (0.0, 0.8):
        chosen = replace(options, normals=weight)
        group = optimize_correspondence(splines, chosen).value
        joint = np.mean([error(group, group.points, faces, i).mean() for i in range(len(ids))])
        right, left, mean_shape = completed(group.points, faces)
        print(
            f"normals {weight}: left out {left_out(splines, chosen, error):.2f} mm, joint model {joint:.2f}; half bones "
            f"{right:.2f} and {left:.2f}, mean shape {mean_shape:.2f}",
            flush=True,
        )


def print_starts(name: str, run: Path, make: Callable[[list[str], np.ndarray], Error]) -> None:
    """Print error and description length at the end of both starts."""
    ids, splines, matrices = fitted(run)
    options, error = options_of(run, splines), make(ids, matrices)
    topology = surface_topology(splines[0])
    wraps, last = topology != "disk", topology in ("cone", "closed")
    faces = grid_faces(*options.landmarks, periodic_u=wraps, pole_start=topology == "closed", pole_end=last)
    cells = []
    for start in ("identity", "affine"):
        found = optimize_correspondence(splines, replace(options, normals=DEFAULT_NORMALS, start=start)).value
        assert all(c.verdict == "proved" for c in found.certificates)
        cells.append((float(error(found, found.points, faces).mean()), found.description_length[1]))
    best = min(e for e, _ in cells)
    shown = [f"{f'**{e:.2f}**' if e == best else f'{e:.2f}'}, {length:.2f}" for e, length in cells]
    print(f"| {name} ({topology}) | " + " | ".join(shown) + " |", flush=True)


def cohorts(options: argparse.Namespace) -> list[tuple[str, Path, Callable[[list[str], np.ndarray], Error]]]:
    """Return name, run and error of all that is there."""
    found: list[tuple[str, Path, Callable[[list[str], np.ndarray], Error]]] = []
    for name, run in (
        ("12 real distal femora, experts", options.distal),
        ("12 real proximal femora, experts", options.proximal),
    ):
        if run is not None:
            every = read_landmarks(options.femora / "landmarks.json")

            def experts(ids: list[str], matrices: np.ndarray, every: dict = every) -> Error:
                marks = {
                    i: {n: m[:3, :3] @ p + m[:3, 3] for n, p in every[i].items()}
                    for i, m in zip(ids, matrices, strict=True)
                }
                return against_experts(ids, marks)

            found.append((name, run, experts))
    if options.synthetic is not None:
        for name, folder in (("12 synthetic aortas", "aorta"), ("29 synthetic proximal femora", "hips")):
            data, run = options.synthetic / folder, options.synthetic / f"{folder}-out"
            if run.is_dir():
                found.append((name, run, lambda ids, m, data=data: against(placed(data, ids, m))))
    if options.families is not None:
        for folder in sorted(options.families.iterdir()):
            run = folder / "out" / "config"
            if (run / "cohort" / "optimize" / "manifest.json").is_file():

                def dense(ids: list[str], matrices: np.ndarray, folder: Path = folder) -> Error:
                    with np.load(folder / "truth.npz") as known:
                        points = known["points"][[list(known["ids"]).index(i) for i in ids]]
                    return against(points @ np.swapaxes(matrices[:, :3, :3], 1, 2) + matrices[:, None, :3, 3])

                found.append((folder.name.rsplit("-", 1)[0], run, dense))
    return found


def main() -> None:
    """Compare and write the tables into the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("--families", "--synthetic", "--femora", "--distal", "--proximal"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--price", action="store_true")
    parser.add_argument("--starts", action="store_true")
    options = parser.parse_args()
    if options.starts:
        for cohort in cohorts(options):
            print_starts(*cohort)
        return
    if options.price:
        print_price(*cohorts(options)[0][1:])
        return
    rows, quality = zip(*[compared(*cohort) for cohort in cohorts(options)], strict=True)
    head = (
        "| cohort | start | "
        + " | ".join("0" if w == 0 else f"{w:g}" for w in WEIGHTS)
        + " |\n"
        + "|---" * (len(WEIGHTS) + 2)
        + "|\n"
    )
    more = "| cohort | weight 0 | weight 0.8 |\n|---|---|---|\n"
    page = HERE / "normals.md"
    text = page.read_text(encoding="utf-8")
    for mark, table in (("errors", head + "\n".join(rows)), ("quality", more + "\n".join(quality))):
        begin, end = f"<!-- {mark} -->\n", f"\n<!-- end {mark} -->"
        text = text[: text.index(begin) + len(begin)] + table + text[text.index(end) :]
    page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
