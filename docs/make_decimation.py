"""Decimate scans of several cohorts and write ``docs/decimation.md``: distances both ways, as in table 4.2 of Li (2015).

    python docs/make_decimation.py --data FOLDER --synthetic FOLDER [--faces 20000 10000 5000] [--n 4]

``--data`` holds ``femur_vsd``, ``spleen``, ``teeth_molar`` and ``aorta_synth``, each with ``scans``; ``--synthetic`` holds ``aorta``
and ``femur-proximal``, made by ``ssmpipe synth NAME FOLDER/NAME``. Every scan is repaired first, as in a run. Distances are given in
thousandths of the bounding box's diagonal where a cohort has no unit.
"""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

import numpy as np

from ssmpipe.contract import Context
from ssmpipe.core.errors import SsmpipeError
from ssmpipe.core.mesh.distance import point_to_mesh, sample_surface
from ssmpipe.core.mesh.topology import boundary_loops, euler_characteristic
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.decimation import decimate
from ssmpipe.io.meshes import read_mesh
from ssmpipe.stages import repair

HERE = Path(__file__).resolve().parent
COHORTS = (
    ("femur_vsd", "data", "mm"),
    ("spleen", "data", "mm"),
    ("aorta_synth", "data", "mm"),
    ("teeth_molar", "data", "1/1000 of the diagonal"),
    ("aorta", "synthetic", "mm"),
    ("femur-proximal", "synthetic", "mm"),
)


def distances(source: TriMesh, target: TriMesh) -> tuple[float, float, float]:
    """Return mean and root mean square over points spread by area, and the maximum over these and the vertices."""
    samples = sample_surface(source, 20000)[0]
    d = point_to_mesh(np.vstack([samples, source.vertices]), target)[0]
    spread = d[: len(samples)]
    return float(spread.mean()), float(np.sqrt((spread**2).mean())), float(d.max())


def topology(mesh: TriMesh) -> tuple[int, int]:
    return euler_characteristic(mesh.faces), len(boundary_loops(mesh.faces))


def repaired(path: Path) -> TriMesh:
    ctx = Context(path.stem, np.random.default_rng(0), logging.getLogger("docs"))
    cfg = repair.Config(max_openings=20, components="largest")
    mesh: TriMesh = repair.run(read_mesh(path), cfg=cfg, ctx=ctx)["mesh"]
    return mesh


def rows_of(folder: Path, name: str, unit: str, targets: list[int], n: int) -> list[str]:
    """Return one row per target: medians over the scans, and the worst maximum."""
    meshes = []
    for path in sorted(folder.iterdir())[:n]:
        try:
            meshes.append(repaired(path))
        except SsmpipeError as error:
            print(f"{path.name}: {error}", flush=True)
    rows = []
    for target in targets:
        figures, kept = [], 0
        for mesh in meshes:
            small = decimate(mesh, target)
            if small.method == "none":
                continue
            scale = 1.0 if unit == "mm" else 1000.0 / float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
            figures.append(scale * np.array([*distances(mesh, small.mesh), *distances(small.mesh, mesh)]))
            kept += topology(small.mesh) == topology(mesh)
        if not figures:
            continue
        middle, worst = np.median(figures, axis=0), np.max(figures, axis=0)
        before = int(np.median([mesh.n_faces for mesh in meshes]))
        cells = [f"{x:.4f}" for x in middle[:2]] + [f"{middle[2]:.3f} ({worst[2]:.3f})"]
        cells += [f"{x:.4f}" for x in middle[3:5]] + [f"{middle[5]:.3f} ({worst[5]:.3f})"]
        rows.append(
            f"| {name} [{unit}] | {before} -> {target} | {kept} of {len(figures)} | " + " | ".join(cells) + " |"
        )
        print(rows[-1], flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--synthetic", type=Path, required=True)
    parser.add_argument("--faces", type=int, nargs="+", default=[20000, 10000, 5000])
    parser.add_argument("--n", type=int, default=4)
    arguments = parser.parse_args()
    logging.disable()
    lines = [
        "# Decimation: how far the surfaces move",
        "",
        f"Made by `python docs/make_decimation.py --data FOLDER --synthetic FOLDER --n {arguments.n}`: the first {arguments.n} scans of "
        "every cohort, repaired, then",
        "`decimate` with default options. Distances from the scan to the decimated surface and back: mean and root mean square over 20 000",
        "points spread by area, maximum (Hausdorff) over these and all vertices. Medians over the scans; in brackets the worst scan.",
        "Topology kept means: same Euler characteristic and number of openings. Open surfaces lose most at their rims, which",
        "`decimate.keep_boundary` keeps.",
        "",
        "| cohort | faces | topology kept | mean, scan to decimated | RMS | max | mean, back | RMS | max |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, where, unit in COHORTS:
        folder = (arguments.data if where == "data" else arguments.synthetic) / name / "scans"
        lines += rows_of(folder, name, unit, arguments.faces, arguments.n)
    (HERE / "decimation.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
