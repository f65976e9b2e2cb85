"""Run the presets on many families with known truth, as a new user would: ``init``, ``check``, ``run``; print what comes out.

    python docs/make_families.py [--work FOLDER] [--only NAME ...] [--seed N] [--jobs N] [--set KEY=VALUE ...] [--pictures]

The cohorts come from public packages (fetched from PyPI into FOLDER; nothing of them is kept here). FOLDER keeps the scans, the truth,
what the commands said, and ``row.json`` with the figures of every family.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from baselines import register  # noqa: E402
from family_cohorts import Family, families  # noqa: E402
from make_femur_proximal import draw_lines, save  # noqa: E402

from ssmpipe.core.align.procrustes import rotation_between  # noqa: E402
from ssmpipe.core.align.rigid import rotation_angle  # noqa: E402
from ssmpipe.core.mesh.distance import point_to_mesh  # noqa: E402
from ssmpipe.core.mesh.trimesh import TriMesh  # noqa: E402
from ssmpipe.io.meshes import read_mesh  # noqa: E402


def carried(source: TriMesh, places: np.ndarray, target_points: np.ndarray) -> np.ndarray:
    """Carry places on one corresponded surface to another one with the same faces."""
    _, face, weights = point_to_mesh(places, source)
    return np.einsum("nk,nkd->nd", weights, target_points[source.faces[face]])


def errors_of(
    points: np.ndarray, faces: np.ndarray, truth: np.ndarray, near: float = 3.0
) -> tuple[np.ndarray, np.ndarray]:
    """Mean error per ordered pair and all errors; a place counts where both scans show it on their corresponded part."""
    on = []
    for p, t in zip(points, truth, strict=True):
        seen = ~np.isnan(t[:, 0])
        near_it = np.zeros(len(t), dtype=bool)
        near_it[seen] = point_to_mesh(t[seen], TriMesh(p, faces))[0] < near
        on.append(near_it)
    n = len(points)
    means, every = np.full((n, n), np.nan), []
    for i in range(n):
        surface = TriMesh(points[i], faces)
        for j in range(n):
            both = on[i] & on[j]
            if i != j and both.any():
                e = np.linalg.norm(carried(surface, truth[i][both], points[j]) - truth[j][both], axis=1)
                means[i, j] = e.mean()
                every.append(e)
    return means, np.concatenate(every)


def baseline(
    meshes: list[TriMesh], truth: np.ndarray, near: float = 3.0, *, affine: bool, n_pairs: int = 14
) -> np.ndarray:
    """Closest points after pairwise ICP from the aligned pose, on a sample of ordered pairs."""
    rng = np.random.default_rng(0)
    n = len(meshes)
    pairs = [(i, j) for i in range(n) for j in range(n) if i != j]
    every = []
    for k in rng.choice(len(pairs), min(n_pairs, len(pairs)), replace=False):
        i, j = pairs[k]
        both = ~np.isnan(truth[i][:, 0]) & ~np.isnan(truth[j][:, 0])
        for s in (i, j):
            at = np.flatnonzero(both)
            both[at] = point_to_mesh(truth[s][at], meshes[s])[0] < near
        matrix = register(meshes[i], meshes[j], affine=affine)
        moved = truth[i][both] @ matrix[:3, :3].T + matrix[:3, 3]
        _, face, weights = point_to_mesh(moved, meshes[j])
        place = np.einsum("nk,nkd->nd", weights, meshes[j].vertices[meshes[j].faces[face]])
        every.append(np.linalg.norm(place - truth[j][both], axis=1))
    return np.concatenate(every)


def askew(placed: np.ndarray, reference: int) -> list[float]:
    """Angle between the pose that every shape was given and the one that brings the true places together [degrees]."""
    angles = []
    for points in placed:
        both = ~np.isnan(points[:, 0]) & ~np.isnan(placed[reference][:, 0])
        a, b = points[both], placed[reference][both]
        angles.append(rotation_angle(rotation_between(a - a.mean(axis=0), b - b.mean(axis=0), np.ones(len(a)))))
    return angles


def ssmpipe(*arguments: str) -> tuple[int, str]:
    done = subprocess.run([sys.executable, "-m", "ssmpipe", *arguments], capture_output=True, text=True)
    return done.returncode, done.stdout + done.stderr


def study(family: Family, work: Path, seed: int, jobs: int, sets: list[str]) -> dict:
    folder = work / f"{family.name}-{seed}"
    if not (folder / "truth.npz").exists():
        family.make(folder, seed)
    config, out = folder / "config.yaml", folder / "out" / "config"
    code, text = ssmpipe("init", family.anatomy, str(folder / "scans"), "-o", str(config), "--overwrite")
    (folder / "init.txt").write_text(text)
    arguments = [a for s in (*family.sets, *sets) for a in ("--set", s)]
    code, text = ssmpipe("check", str(config), *arguments)
    (folder / "check.txt").write_text(f"{code}\n{text}")
    start = time.perf_counter()
    code, text = ssmpipe("run", str(config), *arguments, "--jobs", str(jobs))
    seconds = time.perf_counter() - start
    (folder / "run.txt").write_text(f"{code}\n{text}")
    row: dict = {"name": family.name, "anatomy": family.anatomy, "what": family.what, "code": code, "seconds": seconds}
    failures = out / "failures.json"
    row["failures"] = json.loads(failures.read_text()) if failures.exists() else {}
    row["warnings"] = sum("warn" in line.lower() for line in text.splitlines())
    if not (out / "cohort" / "optimize" / "correspondence.npz").exists():
        return row
    with np.load(out / "cohort" / "optimize" / "correspondence.npz") as c:
        ids, faces = [str(i) for i in c["ids"]], c["faces"]
        before, after, transform = c["initial_points"], c["points"], c["transform"]
        row["dl"] = [float(x) for x in c["description_length"]]
    with np.load(folder / "truth.npz") as known:
        truth = known["points"][[list(known["ids"]).index(i) for i in ids]]
    # lengths in the aligned frame are those of the scan
    placed = truth @ np.swapaxes(transform[:, :3, :3], 1, 2) + transform[:, None, :3, 3]
    row["n"], row["n_all"] = len(ids), len(list((folder / "scans").iterdir()))
    for key, points in (("before", before), ("after", after)):
        means, e = errors_of(points, faces, placed)
        row[key] = [float(e.mean()), float(np.median(e)), float(np.percentile(e, 95))]
        row[key + "_shape"] = dict(zip(ids, np.nanmean(means + means.T, axis=1) / 2, strict=True))
    prepared = json.loads(next((out / "cohort").glob("*-align-prepare/manifest.json")).read_text())
    poses = [
        np.array(json.loads((next((out / "shapes" / i).glob("*-align")) / "transform.json").read_text())) for i in ids
    ]
    at = np.stack([t @ m[:3, :3].T + m[:3, 3] for t, m in zip(truth, poses, strict=True)])
    row["askew_deg"] = dict(zip(ids, askew(at, ids.index(prepared["metrics"]["reference"])), strict=True))
    meshes = [read_mesh(next((out / "shapes" / i).glob("*-align")) / "mesh.ply") for i in ids]
    for key, affine in (("rigid", False), ("affine", True)):
        cache = folder / f"baseline-{key}.json"
        if not cache.exists():
            e = baseline(meshes, at, affine=affine)
            cache.write_text(json.dumps([float(e.mean()), float(np.median(e)), float(np.percentile(e, 95))]))
        row[key] = json.loads(cache.read_text())
    return row


def picture(family: Family, out: Path) -> None:
    """The same parameters on four shapes after the optimization, and where u = 0 runs."""
    z = np.load(out / "cohort" / "optimize" / "correspondence.npz")
    points = z["points"].reshape(len(z["ids"]), *z["grid"], 3)
    if str(z["topology"]) != "disk":
        points = np.concatenate([points, points[:, :1]], axis=1)
    figure, panels = plt.subplots(1, 4, figsize=(13, 4), subplot_kw={"projection": "3d"})
    for axes, k in zip(panels, np.linspace(0, len(points) - 1, 4).astype(int), strict=True):
        draw_lines(axes, points[k], family.view)
        axes.set_title(str(z["ids"][k]), fontsize=9)
    save(figure, f"family_{family.name}")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--work", type=Path, default=Path(tempfile.mkdtemp()))
    parser.add_argument("--only", nargs="*")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--pictures", action="store_true")
    options = parser.parse_args()
    for family in families(options.work / "wheels"):
        if options.only and family.name not in options.only:
            continue
        row = study(family, options.work, options.seed, options.jobs, options.set)
        (options.work / f"{family.name}-{options.seed}" / "row.json").write_text(json.dumps(row, indent=1))
        cells = " ".join(
            f"{k} {row[k][0]:.2f}/{row[k][2]:.1f}" for k in ("before", "after", "rigid", "affine") if k in row
        )
        print(
            family.name,
            f"exit {row['code']}",
            f"{row.get('n', 0)}/{row.get('n_all', '?')}",
            cells,
            f"{row['seconds']:.0f} s",
            flush=True,
        )
        if options.pictures and "after" in row:
            picture(family, options.work / f"{family.name}-{options.seed}" / "out" / "config")
        if "after_shape" in row:
            print("   poses", {k: round(float(v), 1) for k, v in row["askew_deg"].items()}, flush=True)
            print("   per shape", {k: round(float(v), 1) for k, v in row["after_shape"].items()}, flush=True)
        for key, value in row["failures"].items():
            print("   ", key, str(value)[:300], flush=True)


if __name__ == "__main__":
    main()
