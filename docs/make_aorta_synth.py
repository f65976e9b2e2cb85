"""Run the parametrized aortas from shuffled, turned scans to a model, measure it against the shared vertices, write the page.

    python docs/make_aorta_synth.py --scans FOLDER [--work FOLDER]

FOLDER holds ``*.ply`` files with the same vertices in the same order (which no stage may see: they are shuffled first).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

from ssmpipe.core.evaluation.correspondence_error import correspondence_error
from ssmpipe.core.evaluation.measures import generalization
from ssmpipe.core.mesh.distance import point_to_mesh
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.io.meshes import read_mesh, write_mesh
from ssmpipe.report.solid import good_view, picture, view_axes

HERE = Path(__file__).resolve().parent
CONFIG = HERE.parent / "configs" / "aorta_synth.yaml"
VARIANTS = {
    "periodic": {},
    "held": {"optimize.boundary": "fixed"},
    "fixed": {"parameterize.seam": "straight", "fit.seam": "kept", "optimize.boundary": "fixed"},
}
ON_SURFACE = 1.5
"""A shared vertex farther from the prepared surface of any shape was cut away [mm]."""


def shuffled(scans: Path, target: Path) -> np.ndarray:
    """Write every scan with its vertices in another order and in another pose; return the true points (n_S, n_T, 3)."""
    rng = np.random.default_rng(0)
    target.mkdir(parents=True, exist_ok=True)
    truth = []
    for path in sorted(scans.glob("*.ply")):
        mesh = read_mesh(path)
        turn = Rotation.from_quat(rng.normal(size=4)).as_matrix()
        points = mesh.vertices @ turn.T + rng.uniform(-100, 100, 3)
        order = rng.permutation(len(points))
        place = np.argsort(order)
        write_mesh(target / path.name, TriMesh(points[order], place[mesh.faces]))
        truth.append(points)
    return np.array(truth)


def run(work: Path, name: str, options: dict[str, str]) -> float:
    """Run one variant and return its seconds; a folder that exists is brought up to date."""
    start = time.perf_counter()
    changes = {"input.scans": str(work / "scans" / "*.ply"), "output": str(work / name)}
    changes |= {f"stages.{key}": value for key, value in options.items()}
    arguments = [text for key, value in changes.items() for text in ("--set", f"{key}={value}")]
    subprocess.run([sys.executable, "-m", "ssmpipe", "run", str(CONFIG), *arguments], check=True)
    return time.perf_counter() - start


def prepared(folder: Path, ids: list[str]) -> list[TriMesh]:
    """Return the cut mesh of each shape in its scan's frame."""
    out = []
    for i in ids:
        (cut,) = (folder / "shapes" / i).glob("*-cut")
        (align,) = (folder / "shapes" / i).glob("*-align")
        mesh = read_mesh(cut / "mesh.ply")
        back = np.linalg.inv(np.array(json.loads((align / "transform.json").read_text())))
        out.append(TriMesh(mesh.vertices @ back[:3, :3].T + back[:3, 3], mesh.faces))
    return out


def off_diagonal(errors: np.ndarray) -> np.ndarray:
    return errors[~np.eye(len(errors), dtype=bool)]


def measured(folder: Path, truth: np.ndarray) -> dict[str, np.ndarray]:
    c = np.load(folder / "cohort" / "optimize" / "correspondence.npz")
    ids = [str(i) for i in c["ids"]]
    near = np.all(
        [point_to_mesh(t, m)[0] < ON_SURFACE for t, m in zip(truth, prepared(folder, ids), strict=True)], axis=0
    )
    kept = truth[:, near]
    # the rims and filled places of the corresponded surface are coarser than the scan
    before, after = (
        correspondence_error(c[f"{name}points_scan"], c["faces"], kept, max_distance=np.inf)
        for name in ("initial_", "")
    )
    out = {"before": off_diagonal(before), "after": off_diagonal(after), "near": near, "ids": np.array(ids)}
    for name, key in (("generalization_before", "initial_points"), ("generalization_after", "points")):
        out[name] = generalization(c[key], 3)[0]
    out["floor"] = np.diagonal(after).T
    out["length"] = c["description_length"]
    out["per_vertex_before"] = np.array(
        [before[i, j] for i in range(len(ids)) for j in range(len(ids)) if i != j]
    ).mean(axis=0)
    out["per_vertex_after"] = np.array([after[i, j] for i in range(len(ids)) for j in range(len(ids)) if i != j]).mean(
        axis=0
    )
    return out


def row(name: str, errors: np.ndarray) -> str:
    return f"| {name} | {errors.mean():.2f} | {np.median(errors):.2f} | {np.percentile(errors, 95):.2f} | {errors.max():.1f} |"


def draw(work: Path, results: dict[str, dict[str, np.ndarray]], truth: np.ndarray) -> None:
    """Draw the mean error at every kept vertex, before and after, for both boundaries."""
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.4), layout="constrained")
    shape = truth[0] - truth[0].mean(axis=0)
    frame = np.linalg.svd(shape, full_matrices=False)[2]
    flat = shape @ frame[:2].T
    panels = [
        ("before optimization", results["periodic"], "per_vertex_before"),
        ("fixed seam", results["fixed"], "per_vertex_after"),
        ("periodic", results["periodic"], "per_vertex_after"),
    ]
    for ax, (title, one, key) in zip(axes, panels, strict=True):
        ax.scatter(*flat[~one["near"]].T, s=1, color="0.8")
        dots = ax.scatter(*flat[one["near"]].T, c=one[key], s=6, vmin=0, vmax=8, cmap="viridis")
        ax.set_title(f"{title}: mean {one[key].mean():.2f} mm", fontsize=10)
        ax.set_aspect("equal")
        ax.axis("off")
    figure.colorbar(dots, ax=axes, shrink=0.6, label="mean distance to the shared vertex [mm]")
    figure.savefig(HERE / "figures" / "aorta_synth_error.png", dpi=110)
    plt.close(figure)


def page(results: dict[str, dict[str, np.ndarray]], truth: np.ndarray, seconds: dict[str, float]) -> str:
    """Return the text of the page."""
    free, fixed = results["periodic"], results["fixed"]
    n_kept = int(free["near"].sum())
    before, after, held = free["before"].mean(), free["after"].mean(), results["held"]["after"].mean()
    other = fixed["before"].mean()
    rows = [
        row("before, periodic seam", free["before"]),
        row("before, straight seam", fixed["before"]),
        row("after, straight seam, `boundary: fixed`", fixed["after"]),
        row("after, periodic seam, `boundary: fixed`", results["held"]["after"]),
        row("after, periodic seam, `boundary: periodic`", free["after"]),
    ]
    lengths = "; ".join(f"{name}: {one['length'][0]:.1f} to {one['length'][1]:.1f}" for name, one in results.items())
    general = "; ".join(
        f"{name}: {one['generalization_before'][2]:.2f} to {one['generalization_after'][2]:.2f}"
        for name, one in results.items()
    )
    return f"""# Parametrized aortas: from shuffled scans to a model, against shared vertices

Made by `python docs/make_aorta_synth.py --scans FOLDER` from {len(truth)} aortas with three arch branches (SynthAorta, Bosnjak et al.,
arXiv 2409.08635), five openings each, with `configs/aorta_synth.yaml`: branches removed and filled, both ends trimmed, cut open,
mapped with period 1 in u, 12 x 12 coefficients, 51 x 51 landmarks, formulation II. The vertices correspond across the files; they were
shuffled and every scan was turned and shifted at random before the run, so no stage could see that.

## Error against the shared vertices

{n_kept} of {truth.shape[1]} vertices lie within {ON_SURFACE:g} mm of the prepared surface of every shape: the kept parts. Each was carried
from every shape to every other one; the error is the distance to where it belongs [mm].

| | mean | median | 95 % | max |
|---|---|---|---|---|
{chr(10).join(rows)}

The optimization leaves {100 * after / before:.0f} % of the error at the start ({100 * after / other:.0f} % of that of the straight
seam, which starts better). With the same maps, a seam that may move changes the error from {held:.2f} to {after:.2f} mm.
A vertex carried to its own shape is {free["floor"].mean():.2f} mm away from itself: the floor that splines and a grid of
51 x 51 points set. Description length, {lengths}.
Generalization with three modes [mm], {general}.

![Error at each vertex](figures/aorta_synth_error.png)

Grey: cut away.

## The mean and the first modes

![Modes](figures/aorta_synth_modes.png)

The run with all stages: {seconds["periodic"]:.0f} s on two shared cores.
"""


def draw_modes(folder: Path, target: Path) -> None:
    """Draw the mean and three modes at minus and plus three standard deviations."""
    model = np.load(folder / "cohort" / "model" / "model.npz")
    mean, faces = model["mean"], model["faces"]
    view = good_view(mean, faces)
    axes = view_axes(*view)[:2]
    flat = mean @ axes.T
    centre = (flat.min(axis=0) + flat.max(axis=0)) / 2 @ axes
    radius = 0.6 * float(np.ptp(flat, axis=0).max())
    figure, panels = plt.subplots(1, 7, figsize=(14, 2.6))
    shown = [("mean", mean)]
    for m in range(3):
        for sign in (-3, 3):
            shown.append(
                (f"mode {m + 1}, {sign:+d} sd", mean + sign * np.sqrt(model["variances"][m]) * model["modes"][m])
            )
    for panel, (title, points) in zip(panels, shown, strict=True):
        panel.imshow(picture(points, faces, view=view, centre=centre, radius=radius, inches=2.0))
        panel.set_title(title, fontsize=9)
        panel.axis("off")
    figure.tight_layout()
    figure.savefig(target, dpi=110)
    plt.close(figure)


def main() -> None:
    """Run, measure, draw, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=Path, required=True)
    parser.add_argument("--work", type=Path)
    arguments = parser.parse_args()
    work = arguments.work or Path(tempfile.mkdtemp(prefix="aorta-synth-"))
    truth = shuffled(arguments.scans, work / "scans")
    seconds = {name: run(work, name, options) for name, options in VARIANTS.items()}
    results = {name: measured(work / name, truth) for name in VARIANTS}
    draw(work, results, truth)
    draw_modes(work / "periodic", HERE / "figures" / "aorta_synth_modes.png")
    (HERE / "aorta_synth.md").write_text(page(results, truth, seconds))


if __name__ == "__main__":
    main()
