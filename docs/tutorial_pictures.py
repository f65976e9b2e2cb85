"""Pictures of a finished tutorial: three scans, the mean, and the first mode two standard deviations to both sides."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import ssmpipe
from ssmpipe.io.meshes import MESH_SUFFIXES, read_mesh
from ssmpipe.report.solid import good_view, picture


def draw(folder: Path, target: Path) -> None:
    """Draw one row of panels for the run in ``folder/out``."""
    (out,) = (path for path in (folder / "out").iterdir() if (path / "cohort").is_dir())
    model = ssmpipe.load_model(out)
    scans = sorted(p for p in folder.rglob("scans/*") if p.stem in model.ids)[:3]
    instances = [("-2 sd", model.instance([-2.0])), ("mean", model.mean), ("+2 sd", model.instance([2.0]))]
    figure, panels = plt.subplots(1, len(scans) + 3, figsize=(1.9 * (len(scans) + 3), 2.3))
    for panel in panels:
        panel.set_axis_off()
    for panel, path in zip(panels, scans, strict=False):
        panel.set_title(path.name, fontsize=8)
        if path.suffix.lower() in MESH_SUFFIXES:
            _surface(panel, *_mesh(path))
        else:
            panel.imshow(plt.imread(path), cmap="gray")
    low, high = model.mean.min(axis=0), model.mean.max(axis=0)
    centre, radius = (low + high) / 2, 0.62 * float(np.linalg.norm(high - low))
    view = None
    if model.mean.shape[1] == 3:
        mean = model.surface(model.mean)
        view = good_view(np.array(mean.vertices), np.array(mean.faces))
    for panel, (title, points) in zip(panels[len(scans) :], instances, strict=True):
        panel.set_title(f"mode 1: {title}" if title != "mean" else title, fontsize=8)
        if points.shape[1] == 3:
            mesh = model.surface(points)
            _surface(panel, np.array(mesh.vertices), np.array(mesh.faces), centre, radius, view)
        else:
            closed = np.vstack([points, points[:1]]) if model.topology == "curve-closed" else points
            panel.plot(closed[:, 0], -closed[:, 1], color="black", linewidth=1)
            panel.set_aspect("equal")
            panel.set_xlim(centre[0] - radius, centre[0] + radius)
            panel.set_ylim(-centre[1] - radius, -centre[1] + radius)
    figure.tight_layout(pad=0.3)
    figure.savefig(target, dpi=110, bbox_inches="tight", pad_inches=0.05, metadata={"Software": None})
    plt.close(figure)


def _mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    mesh = read_mesh(path)
    return np.array(mesh.vertices), np.array(mesh.faces)


def _surface(
    panel: plt.Axes,
    vertices: np.ndarray,
    faces: np.ndarray,
    centre: np.ndarray | None = None,
    radius: float | None = None,
    view: tuple[float, float] | None = None,
) -> None:
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    middle = (low + high) / 2 if centre is None else centre
    reach = 0.62 * float(np.linalg.norm(high - low)) if radius is None else radius
    panel.imshow(
        picture(vertices, faces, view=view or good_view(vertices, faces), centre=middle, radius=reach, inches=1.9)
    )
