"""Run closed surfaces, spleens and whole femora, and write ``docs/closed.md`` with its figures.

    python docs/make_closed.py --data FOLDER [--work FOLDER]

FOLDER holds ``spleen/scans/*.vtk``, ``vertebra_l1/scans/*.ply``, and ``femur_vsd`` with ``scans/*.ply``, ``cohort.csv`` and
``landmarks.json``.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import tempfile
import textwrap
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from baselines import closest_point_transfer  # noqa: E402
from make_femur_distal import (  # noqa: E402
    measures_text,
    optimization_text,
    read_transform,
    run,
    stage_folder,
    table,
)
from make_femur_proximal import draw_cohort, metrics, parameterization_text  # noqa: E402

from ssmpipe.io.landmarks import read_landmarks  # noqa: E402
from ssmpipe.io.meshes import read_mesh  # noqa: E402
from ssmpipe.io.tables import read_table  # noqa: E402


def transfer_text(out: Path, landmarks: Path, ids: list[str]) -> str:
    """Landmarks before and after, beside the closest point after affine ICP (the same ones, at most 8 mm off the surface)."""
    t = read_table(out / "cohort" / "evaluate" / "landmark_transfer.csv").columns
    found: dict[str, list[str]] = {}
    for name, mean, p95 in zip(t["landmark"], t["mean_mm"], t["p95_mm"], strict=True):
        found.setdefault(name, []).append(f"{float(mean):.2f} / {float(p95):.1f}")
    every = read_landmarks(landmarks)
    meshes, marks = [], []
    for i in ids:
        matrix = read_transform(out / "shapes" / i)
        meshes.append(read_mesh(stage_folder(out / "shapes" / i, "align") / "mesh.ply"))
        marks.append({n: matrix[:3, :3] @ p + matrix[:3, 3] for n, p in every[i].items() if n in found})
    affine = closest_point_transfer(meshes, marks, affine=True)
    affine["all"] = np.concatenate(list(affine.values()))
    rows = [
        [name, *cells, f"{affine[name].mean():.2f} / {np.percentile(affine[name], 95):.1f}"]
        for name, cells in sorted(found.items(), key=lambda item: item[0] == "all")
    ]
    return table(["landmark (mean / 95th percentile, mm)", "before", "after", "closest point, affine ICP"], rows)


def fit_text(out: Path, ids: list[str]) -> str:
    rows = [[metrics(out, i, "fit")[f"mesh_to_spline_{k}_mm"] for k in ("rms", "max")] for i in ids]
    (rms, most), (worst_rms, worst) = np.median(rows, axis=0), np.max(rows, axis=0)
    return (
        f"Decimated mesh to spline: RMS {rms:.3f} mm (worst shape {worst_rms:.3f}), maximum {most:.2f} mm (worst {worst:.2f}); "
        "medians over the shapes.\n"
    )


def refused_text(vertebrae: Path, work: Path) -> str:
    """Run vertebrae, which have a canal, and quote how they are refused."""
    out, config = work / "vertebrae", work / "vertebrae.yaml"
    work.mkdir(parents=True, exist_ok=True)
    config.write_text(
        f"name: vertebrae\ninput: {{scans: {vertebrae}/scans/*.ply, units: mm}}\noutput: {out}\nanatomy: closed\n"
    )
    code = run(["run", str(config), "-q"])[0]
    failed = json.loads((out / "failures.json").read_text(encoding="utf-8"))
    n_scans = len(list(vertebrae.glob("scans/*.ply")))
    (stage,) = {f["stage"] for f in failed.values()}
    loops = ", ".join(re.findall(r"loop of ([0-9.]+) mm", " ".join(f["error"] for f in failed.values())))
    first, why = next(iter(failed.items()))
    quoted = f"failed: {first}, {why['stage']}, {why['file']}: {why['error']}; try: {why['remedy']}"
    return f"""## What is refused

Anatomy with a true hole has no map between two poles, and is named, not mapped: {len(failed)} of {n_scans} L1 vertebrae (`vertebra_l1`,
preset `closed`) are refused in `{stage}`, each with the place of its canal (loops of {loops} mm), and the run ends with exit code {code}:

```
{textwrap.fill(quoted, 140, break_long_words=False, break_on_hyphens=False)}
```
"""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--work", type=Path, default=Path(tempfile.mkdtemp()))
    options = parser.parse_args()
    data = options.data.resolve()
    text = ["# Closed surfaces: what was measured\n"]
    text += ["Made by `python docs/make_closed.py --data FOLDER`; every figure below was printed by that run"]
    text += [f"({os.cpu_count()} cores)."]
    text += ["Each surface is mapped between the two ends of its longest way, periodic in u, without a landmark.\n"]
    femora = data / "femur_vsd"
    studies = (
        ("spleens", "closed", [f"input.scans={data}/spleen/scans/*.vtk"], (20, -60)),
        (
            "whole femora",
            "femur_full",
            [
                f"input.scans={femora}/scans/*.ply",
                f"input.cohort={femora}/cohort.csv",
                f"input.landmarks={femora}/landmarks.json",
            ],
            (10, -100),
        ),
    )
    for title, name, sets, view in studies:
        out = options.work / name
        sets = [*sets, f"output={out}"]
        arguments = [a for s in sets for a in ("--set", s)]
        code, wall, memory = run(["run", str(HERE.parent / "configs" / f"{name}.yaml"), *arguments, "--jobs", "2"])
        if code not in (0, 3):
            raise SystemExit(f"the run ended with exit code {code}")
        ids = [str(i) for i in np.load(out / "cohort" / "optimize" / "correspondence.npz")["ids"]]
        text += [
            f"## {len(ids)} {title}\n\n`configs/{name}.yaml`. Wall time {wall:.0f} s, peak memory {memory:.2f} GB, two jobs.\n"
        ]
        text += [parameterization_text(out, ids), fit_text(out, ids), optimization_text(out)]
        draw_cohort(out, f"closed_{name}", view, "optimized: the same u and v on four shapes, u = 0 in black")
        text += [f"![The same parameters on four shapes](figures/closed_{name}.png)\n"]
        if name == "femur_full":
            text += ["### Landmark transfer\n", transfer_text(out, femora / "landmarks.json", ids)]
            text += [
                "Over all ordered pairs. The raters of these landmarks differ by 2.7 to 5.8 mm among each other.\n"
            ]
        text += ["### Model\n", measures_text(out)]
    text += [refused_text(data / "vertebra_l1", options.work)]
    (HERE / "closed.md").write_text("\n".join(text), encoding="utf-8")


if __name__ == "__main__":
    main()
