"""Draw contact sheets of synthetic cohorts, every scan in its anatomical frame from two sides.

    python docs/make_synth_pictures.py [NAME ...] [--work FOLDER]

Makes each cohort with its default number and seed 0 and writes ``docs/figures/synth_<name>.png``.
"""

from __future__ import annotations

import argparse
import importlib
import tempfile
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from ssmpipe.io.meshes import read_mesh
from ssmpipe.report.solid import picture

HERE = Path(__file__).resolve().parent

SHEETS: dict[str, dict[str, Any]] = {
    "aorta": {"module": "aorta", "options": {}, "views": ((60.0, 8.0), (-75.0, 8.0)), "columns": 8, "crop": 0.7},
    "femur_proximal": {
        "module": "femur_proximal",
        "options": {"groups": True},
        "views": ((90.0, 8.0), (-105.0, 20.0)),
        "columns": 10,
        "crop": 0.55,
    },
}


def contact_sheet(folder: Path, views: tuple[tuple[float, float], ...], columns: int, crop: float) -> plt.Figure:
    """Return a figure with every scan of a cohort, pose undone; ``crop`` is the share of the width that is shown."""
    truth = np.load(folder / "truth.npz")
    shown = []
    for shape_id, pose in zip(truth["ids"], truth["pose"], strict=True):
        path = next((folder / "scans").glob(f"{shape_id}.*"))
        mesh = read_mesh(path)
        inverse = np.linalg.inv(pose)
        faces = mesh.faces[:, ::-1] if np.linalg.det(pose) < 0 else mesh.faces
        shown.append((str(shape_id), mesh.vertices @ inverse[:3, :3].T + inverse[:3, 3], faces))
    centre = np.mean([(v.min(axis=0) + v.max(axis=0)) / 2 for _, v, _ in shown], axis=0)
    radius = max(np.linalg.norm(v - centre, axis=1).max() for _, v, _ in shown)
    rows = -(-len(shown) // columns) * len(views)
    sheet, panels = plt.subplots(rows, columns, figsize=(1.75 * crop * columns, 1.85 * rows), squeeze=False)
    for panel in panels.ravel():
        panel.set_axis_off()
    for k, (shape_id, vertices, faces) in enumerate(shown):
        for j, view in enumerate(views):
            panel = panels[k // columns * len(views) + j, k % columns]
            image = picture(vertices, faces, view=view, centre=centre, radius=radius, inches=1.7)
            side = round(image.shape[1] * (1 - crop) / 2)
            panel.imshow(image[:, side : image.shape[1] - side])
            if j == 0:
                panel.set_title(shape_id, fontsize=7, pad=2)
    sheet.tight_layout(pad=0.2)
    return sheet


def main() -> None:
    """Write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(SHEETS)}; default: all")
    parser.add_argument("--work", type=Path, help="keep the cohorts here")
    arguments = parser.parse_args()
    work = arguments.work or Path(tempfile.mkdtemp())
    for name in arguments.names or SHEETS:
        sheet = SHEETS[name]
        importlib.import_module(f"ssmpipe.synth.{sheet['module']}").write_cohort(work / name, **sheet["options"])
        drawn = contact_sheet(work / name, sheet["views"], sheet["columns"], sheet["crop"])
        drawn.savefig(HERE / "figures" / f"synth_{name}.png", dpi=110)
        plt.close(drawn)


if __name__ == "__main__":
    main()
