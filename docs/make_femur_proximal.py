"""Run the proximal femora, measure everything, and write ``docs/femur_proximal.md`` with its figures.

    python docs/make_femur_proximal.py --data FOLDER [--work FOLDER]

FOLDER holds ``scans/*.ply``, ``cohort.csv`` and ``landmarks.json`` of real femora.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from make_femur_distal import (  # noqa: E402
    fit_rows,
    landmark_text,
    measures_text,
    optimization_text,
    run,
    stage_folder,
    table,
)

from ssmpipe.core.parameterize.cone import parameterize_poles  # noqa: E402
from ssmpipe.core.parameterize.poles import apex_of  # noqa: E402
from ssmpipe.core.parameterize.sampling import sample_grid  # noqa: E402
from ssmpipe.io.meshes import read_mesh  # noqa: E402

TRIM = "Lesser Trochanter (LT)"
APEX = "Medial Femoral Head (MFH)"


def metrics(out: Path, shape: str, stage: str) -> dict:
    return json.loads((stage_folder(out / "shapes" / shape, stage) / "manifest.json").read_text())["metrics"]


def parameterization_text(out: Path, ids: list[str]) -> str:
    rows = []
    for i in ids:
        m = metrics(out, i, "parameterize")
        rings = " / ".join(f"{r:.2f}" for r in m["pole_ring_percent"])
        rows.append([i, f"{m['stretch_before']:.2f}", f"{m['stretch']:.3f}", f"{m['n_flips_harmonic']}", "0", rings])
    header = ["shape", "stretch, harmonic", "in the end", "triangles turned over, harmonic", "in the end"]
    return table([*header, "ring around the poles [% of v]"], rows)


def draw_lines(axes: plt.Axes, samples: np.ndarray, view: tuple[float, float], n: int = 25) -> None:
    for k in np.linspace(0, samples.shape[0] - 1, n).astype(int):
        axes.plot(*samples[k].T, color="tab:blue", lw=0.5)
    for k in np.linspace(0, samples.shape[1] - 1, n).astype(int):
        axes.plot(*samples[:, k].T, color="tab:red", lw=0.5)
    axes.plot(*samples[0].T, color="black", lw=1.6)
    axes.set_aspect("equal")
    axes.view_init(*view)
    axes.set_axis_off()


def save(figure: plt.Figure, name: str) -> None:
    (HERE / "figures").mkdir(exist_ok=True)
    figure.savefig(HERE / "figures" / f"{name}.png", dpi=80, bbox_inches="tight", metadata={"Software": None})
    plt.close(figure)


def draw_steps(out: Path, shape: str) -> None:
    """One bone: the harmonic map, changed in u and v alone, and relaxed."""
    mesh = read_mesh(stage_folder(out / "shapes" / shape, "align") / "mesh.ply")
    apex = apex_of(mesh)
    figure, panels = plt.subplots(1, 3, figsize=(12, 4.6), subplot_kw={"projection": "3d"})
    steps = (
        ("harmonic", {"max_iterations": 0, "n_remap": 0}),
        ("u and v changed alone", {"max_iterations": 0}),
        ("relaxed, then changed", {}),
    )
    for axes, (title, options) in zip(panels, steps, strict=True):
        found = parameterize_poles(mesh, apex, **options)
        draw_lines(axes, sample_grid(found.mesh, found.uv, 200, 200, found.seam), (15, -110))
        axes.set_title(f"{title}: stretch {found.stretch[-1]:.2f}, ring {100 * found.ring[0]:.1f} %", fontsize=9)
    save(figure, "femur_proximal_map")


def draw_cohort(out: Path, name: str, view: tuple[float, float], title: str) -> None:
    """The same parameters on four shapes after the optimization."""
    z = np.load(out / "cohort" / "optimize" / "correspondence.npz")
    points = z["points"].reshape(len(z["ids"]), *z["grid"], 3)
    points = np.concatenate([points, points[:, :1]], axis=1)
    figure, panels = plt.subplots(1, 4, figsize=(13, 4), subplot_kw={"projection": "3d"})
    for axes, k in zip(panels, np.linspace(0, len(points) - 1, 4).astype(int), strict=True):
        draw_lines(axes, points[k], view)
        axes.set_title(str(z["ids"][k]), fontsize=9)
    figure.suptitle(title, fontsize=10)
    save(figure, name)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--work", type=Path, default=Path(tempfile.mkdtemp()))
    options = parser.parse_args()
    data = options.data.resolve()
    config = str(HERE.parent / "configs" / "femur_proximal.yaml")
    sets = [f"input.scans={data}/scans/*.ply", f"input.cohort={data}/cohort.csv"]
    sets += [f"input.landmarks={data}/landmarks.json"]
    text = ["# Proximal femora: what was measured\n"]
    text += ["Made by `python docs/make_femur_proximal.py --data FOLDER`; every figure below was printed by that run"]
    text += [f"({os.cpu_count()} cores).\n"]
    studies = (
        (
            "cut by the lesser trochanter",
            "cut 0.7 shaft diameters below the landmark of the lesser trochanter, apex from geometry",
            {"trim": TRIM},
        ),
        ("apex by a landmark", f"the {APEX} is the apex, and so out of competition", {"trim": TRIM, "apex": APEX}),
        (
            "no landmark at all",
            "cut 0.7 shaft diameters below the lesser trochanter that geometry finds, apex from geometry",
            {},
        ),
    )
    for k, (title, words, roles) in enumerate(studies):
        out = options.work / f"study-{k}"
        every = [*sets, f"input.roles={json.dumps(roles)}", f"output={out}"]
        code, wall, memory = run(["run", config, *[a for s in every for a in ("--set", s)], "--jobs", "2"])
        if code not in (0, 3):
            raise SystemExit(f"the run ended with exit code {code}")
        ids = [str(i) for i in np.load(out / "cohort" / "optimize" / "correspondence.npz")["ids"]]
        text += [f"## {len(ids)} real femora, {title}\n\n{words[0].upper()}{words[1:]}. Wall time {wall:.0f} s, "]
        text += [f"peak memory of all processes {memory:.2f} GB, two jobs.\n", optimization_text(out)]
        text += ["### Landmark transfer\n", landmark_text(out, data, ids)]
        if k > 0:
            continue
        text += ["Over all ordered pairs. The raters of these landmarks differ by 2.7 to 5.8 mm among each other.\n"]
        text += ["### Maps\n", parameterization_text(out, ids)]
        text += ["Stretch is at the best ratio of the units of u and v; 1 is a map that only scales them.\n"]
        text += ["![Parameter lines of one femur](figures/femur_proximal_map.png)\n"]
        text += ["![The same parameters on four femora](figures/femur_proximal_lines.png)\n"]
        rows = fit_rows(out, ids)
        cells = [["median", *[f"{v:.3f}" for v in np.median(rows, axis=0)]]]
        cells += [["worst", *[f"{v:.3f}" for v in np.max(rows, axis=0)]]]
        text += ["### Spline against trimmed mesh\n"]
        text += [table(["", "mesh to spline, RMS [mm]", "max", "spline to mesh, RMS", "max"], cells)]
        text += ["The trimmed mesh is the scan's own surface, before smoothing and decimation.\n"]
        text += ["### Model\n", measures_text(out)]
        draw_steps(out, ids[0])
        draw_cohort(
            out, "femur_proximal_lines", (15, -110), "optimized: the same u and v on four femora, u = 0 in black"
        )
    (HERE / "femur_proximal.md").write_text("\n".join(text) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
