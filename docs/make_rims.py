"""Measure what free rims gain and cost: the same bones cut at one height and at three, synthetic aortas, real femora; write a page.

    python docs/make_rims.py [--work FOLDER] [--data FOLDER] [--families FOLDER]

``--data`` is a folder with ``scans/``, ``cohort.csv`` and ``landmarks.json`` of femora; ``--families`` one that make_families.py has
filled. Rows that need them are left out without.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from make_families import carried  # noqa: E402
from make_femur_proximal import draw_lines, save  # noqa: E402
from study_cohorts import expert_error, fitted, run_to_fit  # noqa: E402

from ssmpipe.core.correspondence.choices import boundary_of, rims_of, start_of  # noqa: E402
from ssmpipe.core.correspondence.normals import DEFAULT_NORMALS  # noqa: E402
from ssmpipe.core.correspondence.optimize import optimize_correspondence  # noqa: E402
from ssmpipe.core.correspondence.optimum import Optimum  # noqa: E402
from ssmpipe.core.correspondence.options import EngineOptions  # noqa: E402
from ssmpipe.core.mesh.distance import point_to_mesh  # noqa: E402
from ssmpipe.core.mesh.grid import grid_faces  # noqa: E402
from ssmpipe.core.mesh.trimesh import TriMesh  # noqa: E402
from ssmpipe.core.spline.evaluate import Spline  # noqa: E402
from ssmpipe.core.spline.poles import surface_topology  # noqa: E402
from ssmpipe.io.landmarks import read_landmarks  # noqa: E402

HEIGHTS = ("0.85", "1.0", "1.2")
NEAR = 1.5
"""A true place farther from the corresponded surface of any shape does not count [mm]."""


@dataclass
class Cohort:
    """Splines, and true places (n_S, n_T, 3) in their frame, or an error of its own."""

    name: str
    splines: list[Spline]
    truth: np.ndarray | None = None
    error: Callable | None = None


def optimized(splines: list[Spline], rims: str) -> Optimum:
    topology = surface_topology(splines[0])
    start = start_of(
        "auto", topology=topology, normalize="affine", guided=False, reference="nearest-to-mean", rims=rims
    )
    options = EngineOptions(
        start=start,
        boundary=boundary_of("auto", topology),
        rims=rims,
        open_edges=rims_of(topology),
        normals=DEFAULT_NORMALS,
    )
    return optimize_correspondence(splines, options).value


def faces_of(optimum: Optimum, splines: list[Spline]) -> np.ndarray:
    topology = surface_topology(splines[0])
    n = round(optimum.points.shape[1] ** 0.5)
    return grid_faces(n, n, periodic_u=topology != "disk", pole_start=False, pole_end=topology == "cone")


def compare(cohort: Cohort) -> tuple[str, dict[str, Optimum]]:
    """Return a row of the table and both results."""
    results = {rims: optimized(cohort.splines, rims) for rims in ("kept", "free")}
    faces = faces_of(results["kept"], cohort.splines)
    if cohort.truth is None:
        cells = []
        for key, points in (("kept", "initial_points"), ("kept", "points"), ("free", "points")):
            o = results[key]
            # landmarks lie in the frame of the splines
            back = np.einsum(
                "iba,ilb->ila", o.alignment.rotation, getattr(o, points) - o.alignment.translation[:, None]
            )
            cells.append(cohort.error(back, (51, 51)))
    else:
        sets = []
        for key, points in (("kept", "initial_points"), ("kept", "points"), ("free", "points")):
            o = results[key]
            placed = cohort.truth @ np.swapaxes(o.alignment.rotation, 1, 2) + o.alignment.translation[:, None]
            sets.append((getattr(o, points), placed))
        shown = ~np.isnan(cohort.truth[..., 0]).any(axis=0)
        for points, placed in sets:
            for p, t in zip(points, placed, strict=True):
                shown[shown] = point_to_mesh(t[shown], TriMesh(p, faces))[0] < NEAR
        cells = []
        for points, placed in sets:
            every = [
                np.linalg.norm(
                    carried(TriMesh(points[i], faces), placed[i][shown], points[j]) - placed[j][shown], axis=1
                )
                for i in range(len(points))
                for j in range(len(points))
                if i != j
            ]
            cells.append((float(np.mean(every)), float(np.percentile(every, 95))))
    free = results["free"]
    assert all(c.verdict == "proved" for o in results.values() for c in o.certificates)
    window = " × ".join(f"{a:.2f}-{b:.2f}" for a, b in zip(free.window.low, free.window.high, strict=True))
    shift = float(results["kept"].rim_shifts.mean())
    start, kept, free_cell = (f"{mean:.2f} / {p95:.1f}" for mean, p95 in cells)
    return f"| {cohort.name} | {100 * shift:.1f} % | {start} | {kept} | {free_cell} | {window} |", results


def synthetic(name: str, work: Path, *options: str) -> Path:
    folder = work / name
    if not (folder / "truth.npz").is_file():
        subprocess.run([sys.executable, "-m", "ssmpipe", "synth", name, str(folder), *options], check=True)
    return folder


def placed(data: Path, ids: list[str], matrices: np.ndarray) -> np.ndarray:
    with np.load(data / "truth.npz") as known:
        all_ids = sorted(p.stem for p in (data / "scans").iterdir())
        truth = known["points"][[all_ids.index(i) for i in ids]]
        if "covered" in known:
            truth = truth[:, known["covered"].all(axis=0)]
    return truth @ np.swapaxes(matrices[:, :3, :3], 1, 2) + matrices[:, None, :3, 3]


def femora(work: Path) -> list[Cohort]:
    """Twelve synthetic distal femora cut at one height, and the same bones at three heights in turn."""
    data = synthetic("femur-distal", work, "--n", "12")
    cut = {}
    for height in HEIGHTS:
        out = work / f"femur-distal-{height}"
        sets = (f"input.scans={data}/scans/*.ply", f"input.cohort={data}/cohort.csv", "input.landmarks=null")
        if not (out / "run.json").is_file():
            run_to_fit(HERE.parent / "configs" / "femur_distal.yaml", out, *sets, f"stages.trim.fraction={height}")
        ids, splines, matrices = fitted(out)
        cut[height] = splines, placed(data, ids, matrices)
    found = []
    for name, heights in (("cut at one height", ("1.0",)), ("the same bones, cut at three heights", HEIGHTS)):
        chosen = [cut[heights[i % len(heights)]] for i in range(len(ids))]
        truth = np.stack([t[i] for i, (_, t) in enumerate(chosen)])[:, ::4]
        found.append(Cohort(f"12 synthetic distal femora, {name}", [s[i] for i, (s, _) in enumerate(chosen)], truth))
    return found


def aortas(work: Path) -> list[Cohort]:
    """Synthetic aortas cut just inside their rims, which lie anywhere, and by their sinuses."""
    data = synthetic("aorta", work, "--n", "12")
    found = []
    for name, trim in (
        ("cut inside the ragged rims", "{ends_at: rims}"),
        ("cut 55 mm long from the sinuses", "{tube_mm: 55.0}"),
    ):
        out, config = work / f"aorta-{trim[1:5]}", work / f"aorta-{trim[1:5]}.yaml"
        config.write_text(
            f"name: a\ninput:\n  scans: {data}/scans\n  landmarks: {data}/landmarks.json\n  units: mm\noutput: {out}\nanatomy: aorta\n"
            f"stages: [{{trim: {trim}}}]\n"
        )
        if not (out / "run.json").is_file():
            run_to_fit(config, out)
        ids, splines, matrices = fitted(out)
        found.append(Cohort(f"12 synthetic aortas, {name}", splines, placed(data, ids, matrices)))
    return found


def real(work: Path, data: Path) -> list[Cohort]:
    """Real distal femora with expert landmarks."""
    out = work / "real"
    if not (out / "run.json").is_file():
        sets = [f"input.{k}={data}/{v}" for k, v in (("scans", "scans/*.ply"), ("cohort", "cohort.csv"))]
        sets.append(f"input.landmarks={data}/landmarks.json")
        run_to_fit(HERE.parent / "configs" / "femur_distal.yaml", out, *sets)
    ids, splines, matrices = fitted(out)
    every = read_landmarks(data / "landmarks.json")
    marks = {i: {n: m[:3, :3] @ p + m[:3, 3] for n, p in every[i].items()} for i, m in zip(ids, matrices, strict=True)}
    return [Cohort("12 real distal femora, expert landmarks", splines, error=expert_error(ids, marks))]


def from_families(folder: Path) -> list[Cohort]:
    """What make_families.py has made, of bones and faces that end somewhere."""
    known = {
        "tibia-proximal": "8 upper tibiae, cut at 30 % of their length, askew",
        "tibia-distal": "8 lower tibiae, cut at 25 % of their length, askew",
        "femur-proximal": "8 upper femora, cut below the trochanter",
        "faces": "8 faces",
    }
    found = []
    for name, what in known.items():
        data = folder / f"{name}-0"
        if not (data / "out").is_dir():
            continue
        ids, splines, matrices = fitted(data / "out" / "config")
        with np.load(data / "truth.npz") as z:
            truth = z["points"][[list(z["ids"]).index(i) for i in ids]]
        truth = truth @ np.swapaxes(matrices[:, :3, :3], 1, 2) + matrices[:, None, :3, 3]
        found.append(Cohort(what, splines, truth))
    return found


def draw(results: dict[str, Optimum], name: str, view: tuple[float, float]) -> None:
    """Four shapes with kept and with free rims, the same parameters on all."""
    figure, panels = plt.subplots(2, 4, figsize=(12, 6.4), subplot_kw={"projection": "3d"})
    for row, (rims, o) in zip(panels, results.items(), strict=True):
        n = round(o.points.shape[1] ** 0.5)
        for axes, k in zip(row, (0, 1, 2, 5), strict=True):
            draw_lines(axes, o.points[k].reshape(n, n, 3), view, 17)
        row[0].set_title(f"rims {rims}", fontsize=10)
    save(figure, name)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--families", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        work = args.work or Path(temporary)
        work.mkdir(parents=True, exist_ok=True)
        cohorts = [*femora(work), *aortas(work)]
        cohorts += real(work, args.data) if args.data else []
        cohorts += from_families(args.families) if args.families else []
        rows = []
        for k, cohort in enumerate(cohorts):
            row, results = compare(cohort)
            print(row, flush=True)
            rows.append(row)
            if k == 1:
                draw(results, "rims_femora", (12, -60))
    page = HERE / "rims.md"
    head, _, rest = page.read_text().partition("<!-- table -->")
    tail = rest.partition("<!-- end -->")[2]
    page.write_text(f"{head}<!-- table -->\n" + "\n".join([TABLE, *rows]) + f"\n<!-- end -->{tail}")


TABLE = """| cohort | rims apart | start | rims kept | rims free | window |
|---|---|---|---|---|---|"""

if __name__ == "__main__":
    main()
