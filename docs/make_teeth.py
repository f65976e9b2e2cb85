"""Run the teeth, measure everything, and write ``docs/teeth.md`` with its figures.

    python docs/make_teeth.py --scans FOLDER [--work FOLDER]

FOLDER holds crowns with one rim each (15 primate molars of the Auto3DGM sample data), in any pose and of either side.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from itertools import permutations
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.colors import LightSource
from scipy.ndimage import gaussian_filter, maximum_filter

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from make_femur_distal import optimization_text, run, table  # noqa: E402
from make_femur_proximal import metrics, save  # noqa: E402

PROMINENT = 0.35
"""A cusp is a local maximum of the height over the rim's plane above this share of the tooth's largest height."""


def heights(points: np.ndarray) -> np.ndarray:
    """Return the height of (n, n, 3) grid points above the plane through the rim, the crown upwards."""
    rim = np.concatenate([points[0], points[-1], points[1:-1, 0], points[1:-1, -1]])
    normal = np.linalg.svd(rim - rim.mean(axis=0))[2][2]
    height = (points - rim.mean(axis=0)) @ normal
    return height if height.mean() > 0 else -height


def cusps(points: np.ndarray) -> np.ndarray:
    """Return the (n, 2) grid places of the cusps of one tooth."""
    height = gaussian_filter(heights(points), 1.0)
    peak = (height == maximum_filter(height, size=9)) & (height > PROMINENT * height.max())
    peak[[0, -1]] = peak[:, [0, -1]] = False
    return np.argwhere(peak)


def cusp_distances(points: np.ndarray) -> np.ndarray:
    """Return how far each cusp, carried to every other tooth, lies from the nearest cusp there, in sizes of the mean tooth."""
    size = np.sqrt(((points - points.mean(axis=(1, 2), keepdims=True)) ** 2).sum(axis=-1).mean())
    places = [cusps(p) for p in points]
    found = []
    for i, j in permutations(range(len(points)), 2):
        there = points[j][tuple(places[j].T)]
        carried = points[j][tuple(places[i].T)]
        found.extend(np.linalg.norm(carried[:, None] - there[None], axis=2).min(axis=1) / size)
    return np.array(found)


def draw(points: np.ndarray, ids: list[str], name: str, title: str) -> None:
    """Draw teeth from above with a checkerboard of their parameters and their cusps."""
    figure, panels = plt.subplots(3, 5, figsize=(13, 8), layout="constrained")
    light = LightSource(315, 50)
    mean = points.mean(axis=0)
    rim = np.concatenate([mean[0], mean[-1], mean[1:-1, 0], mean[1:-1, -1]])
    normal = np.linalg.svd(rim - rim.mean(axis=0))[2][2]
    normal = normal if ((mean - rim.mean(axis=0)) @ normal).mean() > 0 else -normal
    x = np.linalg.svd((mean - mean.mean(axis=(0, 1))).reshape(-1, 3) @ (np.eye(3) - np.outer(normal, normal)))[2][0]
    frame = np.array([x, np.cross(normal, x), normal])
    n = points.shape[1]
    for ax, p, shape in zip(panels.ravel(), points, ids, strict=False):
        flat = p @ frame.T
        corners = flat[:-1, :-1], flat[1:, :-1], flat[1:, 1:], flat[:-1, 1:]
        quads = np.stack(corners, axis=2).reshape(-1, 4, 3)
        i, j = (k.ravel() for k in np.meshgrid(np.arange(n - 1), np.arange(n - 1), indexing="ij"))
        face = np.cross(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1])
        face *= np.sign(face[:, 2].sum()) / np.maximum(np.linalg.norm(face, axis=1, keepdims=True), 1e-12)
        shade = 0.35 + 0.65 * np.clip(face @ light.direction, 0, 1)
        check = ((i // 5 + j // 5) % 2)[:, None]
        tint = np.where(check, [0.95, 0.9, 0.75], [0.45, 0.6, 0.85])
        order = np.argsort(quads[:, :, 2].mean(axis=1))
        colors = np.clip(tint * shade[:, None], 0, 1)[order]
        ax.add_collection(
            matplotlib.collections.PolyCollection(quads[order, :, :2], facecolors=colors, edgecolors=colors, lw=0.3)
        )
        ax.plot(*flat[tuple(cusps(p).T)][:, :2].T, "o", color="crimson", ms=4)
        ax.set_title(shape, fontsize=9)
        ax.autoscale()
    for ax in panels.ravel():
        ax.set_aspect("equal")
        ax.axis("off")
    figure.suptitle(title, fontsize=10)
    save(figure, name)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--scans", type=Path, required=True)
    parser.add_argument("--work", type=Path, default=Path(tempfile.mkdtemp()))
    options = parser.parse_args()
    out = options.work / "teeth"
    arguments = ["run", str(HERE.parent / "configs" / "teeth.yaml")]
    arguments += ["--set", f"input.scans={options.scans.resolve()}/*", "--set", f"output={out}", "--jobs", "2"]
    code, _, _ = run(arguments)
    if code not in (0, 3):
        raise SystemExit(f"the run ended with exit code {code}")
    z = np.load(out / "cohort" / "optimize" / "correspondence.npz")
    ids = [str(i) for i in z["ids"]]
    n_scans = len(list(options.scans.iterdir()))
    failed = json.loads((out / "failures.json").read_text()) if (out / "failures.json").is_file() else {}
    before, after = (z[k].reshape(len(ids), *z["grid"], 3) for k in ("initial_points", "points"))
    rows = []
    for i, tooth in zip(ids, after, strict=True):
        m, r = metrics(out, i, "align"), metrics(out, i, "repair")
        doubt = m["cost_unit"] > 0.95 * m["other_image_cost_unit"]
        size = ("area_unit2", "volume_unit3", "n_loops", "n_vertices", "n_faces")
        words = ", ".join(f"{k.replace('_', ' ')} {v}" for k, v in r.items() if v and k not in size) or "-"
        image = ("yes" if m["mirrored"] else "no") + (", doubtful" if doubt else "")
        costs = [f"{m['cost_unit']:.3f}", f"{m['other_image_cost_unit']:.3f}"]
        rows.append(
            [i, words, image, *costs, f"{metrics(out, i, 'parameterize')['stretch']:.2f}", str(len(cusps(tooth)))]
        )
    distances = cusp_distances(before), cusp_distances(after)
    draw(before, ids, "teeth_before", "before the optimization: the same squares on every tooth; red: cusps")
    draw(after, ids, "teeth_after", "after the optimization")
    cells = [
        [name, *(f"{v:.3f}" for v in (d.mean(), np.median(d), np.percentile(d, 95)))]
        for name, d in zip(("before", "after"), distances, strict=True)
    ]
    refused = "".join(f"- `{i}`, {f['stage']}: {f['error']}\n" for i, f in failed.items())
    text = [
        "# Molar crowns: what was measured\n",
        "Made by `python docs/make_teeth.py --scans FOLDER` with `configs/teeth.yaml` on 15 primate molars (Auto3DGM sample data):",
        "no common pose, no unit, left and right mixed and not labelled",
        f"({os.cpu_count()} cores). {len(ids)} of {n_scans} finish.\n",
        refused,
        "## Scans\n",
        table(
            ["tooth", "repaired", "mirrored", "distance to the reference", "of the other image", "stretch", "cusps"],
            rows,
        ),
        "Mirrored: the mirror image fits the reference better. Doubtful: by less than 5 %, which the report warns of; nothing but the fit",
        "speaks for either then.\n",
        "## Do cusps lie on cusps?\n",
        "Each cusp (a local maximum of the height over the rim's plane) was carried to every other tooth; its distance to the nearest cusp",
        "there, in root mean square radii of a tooth:\n",
        table(["", "mean", "median", "95 %"], cells),
        "![Before](figures/teeth_before.png)\n",
        "![After](figures/teeth_after.png)\n",
        "## Optimization and model\n",
        optimization_text(out).replace(" mm²", " (the files have no unit)"),
    ]
    (HERE / "teeth.md").write_text("\n".join(text) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
