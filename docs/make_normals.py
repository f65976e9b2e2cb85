"""What the weight of normals in the description length does, on every finished run that is given; write a page.

    python docs/make_normals.py --families FOLDER --synthetic FOLDER --femora DATA --distal RUN --proximal RUN

``--families`` was filled by make_families.py, ``--synthetic`` by make_synthetic_cohorts.py; RUN are outputs of
``configs/femur_distal.yaml`` and ``configs/femur_proximal.yaml`` on DATA (``scans/``, ``cohort.csv``, ``landmarks.json``). Each row
takes the splines and all other options of its run.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from make_families import errors_of  # noqa: E402
from make_rims import placed  # noqa: E402
from study_cohorts import fitted  # noqa: E402

from ssmpipe.core.correspondence.choices import boundary_of, start_of  # noqa: E402
from ssmpipe.core.correspondence.optimize import EngineOptions, Optimum, optimize_correspondence  # noqa: E402
from ssmpipe.core.evaluation.landmark_transfer import landmark_transfer  # noqa: E402
from ssmpipe.core.evaluation.measures import generalization, specificity  # noqa: E402
from ssmpipe.core.mesh.grid import grid_faces  # noqa: E402
from ssmpipe.core.spline.evaluate import Spline  # noqa: E402
from ssmpipe.core.spline.poles import surface_topology  # noqa: E402
from ssmpipe.io.landmarks import read_landmarks  # noqa: E402

WEIGHTS = (0.0, 0.3, 0.5, 0.8, 1.1, 1.6)
Error = Callable[[Optimum, np.ndarray, np.ndarray], np.ndarray]


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

    def error(found: Optimum, points: np.ndarray, faces: np.ndarray) -> np.ndarray:
        poses = zip(ids, found.alignment.rotation, found.alignment.translation, strict=True)
        moved = {i: {n: r @ p + t for n, p in marks[i].items()} for i, r, t in poses}
        transfers = landmark_transfer(points, faces, ids, moved, max_distance=8.0)
        every = np.concatenate([t.off_diagonal() for t in transfers])
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
        found = optimize_correspondence(splines, EngineOptions(**{**options.__dict__, "normals": weight})).value
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
    rows, quality = zip(*[compared(*cohort) for cohort in cohorts(parser.parse_args())], strict=True)
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
