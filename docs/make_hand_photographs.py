"""Render photographs of hands, take them through the whole chain, measure everything, and write ``docs/hand_photographs.md``.

python docs/make_hand_photographs.py [--work FOLDER] [--n 40]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from ssmpipe.core.errors import SsmpipeError
from ssmpipe.core.model.pca import principal_components
from ssmpipe.core.outline.distance import point_to_segments
from ssmpipe.core.outline.outline import edge_indices
from ssmpipe.core.outline.segmentation import find_outline
from ssmpipe.io.images import read_image
from ssmpipe.io.outlines import read_outline
from ssmpipe.io.tables import read_table

HERE = Path(__file__).resolve().parent
CONFIG = HERE.parent / "configs" / "hand_photographs.yaml"
RUNS = {
    "stem (the config as it is)": [],
}
N_TRACED = 4  # pictures whose outlines are compared with the truth
NEAR = 4.0  # pixels; true points farther from an outline were cut away with the arm


def table(header: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return "\n".join(lines + ["| " + " | ".join(r) + " |" for r in rows]) + "\n"


def segmentation_rows(data: Path, method: str) -> tuple[list[str], int]:
    """Distances between the outlines found and the true ones, both ways [pixels], and how many pictures were refused."""
    squares, largest, refused = [], [], 0
    for path in sorted((data / "scans").iterdir())[:N_TRACED]:
        truth = read_outline(data / "outlines" / f"{path.stem}.csv")
        try:
            found = find_outline(read_image(path), method).opened  # type: ignore[arg-type]
        except SsmpipeError:
            refused += 1
            continue
        there = point_to_segments(found.points, truth.points, truth.edges)[0]
        back = point_to_segments(truth.points, found.points, found.edges)[0]
        squares.append(np.sqrt(0.5 * ((there**2).mean() + (back**2).mean())))
        largest.append(max(there.max(), back.max()))
    numbers = [np.median(squares), max(squares), np.median(largest), max(largest)]
    return [f"{x:.2f}" for x in numbers], refused


def carried_error(points: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Carry true points from every shape to every other along corresponded polylines; distances to where they belong."""
    edges = edge_indices(points.shape[1], False)
    places = [point_to_segments(t, p, edges) for p, t in zip(points, truth, strict=True)]
    kept = np.all([distance <= NEAR for distance, _, _ in places], axis=0)
    errors = []
    for i, (_, edge, weights) in enumerate(places):
        carried = np.einsum("tk,jtkd->jtd", weights[kept], points[:, edges[edge[kept]]])
        errors.append(np.delete(np.linalg.norm(carried - truth[:, kept], axis=-1), i, axis=0))
    return np.array(errors)


def pictures(data: Path, out: Path, target: Path) -> None:
    figure, axes = plt.subplots(2, 6, figsize=(13, 6.2))
    for axis, path in zip(axes.flat, sorted((data / "scans").iterdir()), strict=False):
        image = read_image(path)
        axis.imshow(image.colors)
        line = read_outline(next((out / "shapes" / path.stem).glob("*-contour")) / "contour.csv").points
        axis.plot(*line.T, color="#ff3030", lw=1.0)
        axis.plot(*line[0], "o", ms=4, color="#30d030")
        axis.plot(*line[-1], "o", ms=4, color="#3080ff")
        axis.axis("off")
    figure.tight_layout(pad=0.3)
    figure.savefig(target, dpi=90)
    plt.close(figure)


def modes(found: dict[str, np.ndarray], target: Path) -> None:
    """First three modes at three standard deviations, before and after."""
    figure, axes = plt.subplots(2, 3, figsize=(11, 8))
    for row, (name, key) in zip(axes, (("before", "initial_points"), ("after", "points")), strict=True):
        mean, directions, variances = principal_components(found[key])[:3]
        for k, axis in enumerate(row):
            for sign, color in ((-3, "#3070c0"), (0, "#999999"), (3, "#d06020")):
                shape = mean + sign * np.sqrt(variances[k]) * directions[k]
                axis.plot(*shape.T, color=color, lw=1.2)
            share = 100 * variances[k] / variances.sum()
            axis.set_title(f"{name}, mode {k + 1}: {share:.0f} %", fontsize=9)
            axis.set_aspect("equal")
            axis.invert_yaxis()
            axis.axis("off")
    figure.tight_layout()
    figure.savefig(target, dpi=80)
    plt.close(figure)


def transfer(out: Path) -> dict[tuple[str, str], float]:
    columns = read_table(out / "cohort/evaluate/landmark_transfer.csv").columns
    return {
        (name, which): float(mean)
        for name, which, mean in zip(columns["landmark"], columns["correspondence"], columns["mean_mm"], strict=True)
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path)
    parser.add_argument("--n", type=int, default=40)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        work = given.work or Path(scratch)
        data = work / "data"
        ssmpipe = [sys.executable, "-m", "ssmpipe"]
        subprocess.run([*ssmpipe, "synth", "hand-photographs", str(data), "--n", str(given.n)], check=True)
        with np.load(data / "truth.npz") as file:
            truth = {name: file[name] for name in file.files}
        write(work, data, truth, ssmpipe)


def write(work: Path, data: Path, truth: dict[str, np.ndarray], ssmpipe: list[str]) -> None:
    rows, marks = [], {}
    for k, (name, options) in enumerate(RUNS.items()):
        out = work / f"run_{k}"
        inputs = [f"input.scans={data}/scans/*.jpg", f"input.landmarks={data}/landmarks.csv", f"output={out}"]
        sets = [part for text in (*inputs, *options) for part in ("--set", text)]
        code = subprocess.run([*ssmpipe, "run", str(CONFIG), "-q", *sets], check=False).returncode
        with np.load(out / "cohort/optimize/correspondence.npz") as file:
            found = {key: file[key] for key in file.files if key != "faces"}
        dense = {key: carried_error(found[f"{key}_scan"], truth["points"]) for key in ("initial_points", "points")}
        marks[name] = transfer(out)
        numbers = [f"{marks[name]['all', which]:.1f}" for which in ("initial", "optimized")]
        numbers += [
            f"{dense[key].mean():.1f} ({np.quantile(dense[key], 0.95):.1f})" for key in ("initial_points", "points")
        ]
        rows.append([name, f"{len(found['ids'])}, exit code {code}", *numbers])
        if k == 0:
            pictures(data, out, HERE / "figures" / "hand_photographs.png")
            modes(found, HERE / "figures" / "hand_photographs_modes.png")
    first = next(iter(marks.values()))
    names = [str(name) for name in truth["landmark_names"]]
    each = [[n, f"{first[n, 'initial']:.1f}", f"{first[n, 'optimized']:.1f}"] for n in names]
    found_rows = []
    for method in ("auto", "silhouette"):
        numbers, refused = segmentation_rows(data, method)
        found_rows.append([method, *numbers, str(refused)])
    height = np.median(np.linalg.norm(np.ptp(truth["points"], axis=1), axis=1))
    (HERE / "hand_photographs.md").write_text(
        f"""# Hands from photographs: what was measured

Made by `python docs/make_hand_photographs.py`; every figure below was printed by that run. The {len(truth["ids"])} photographs
are rendered by `ssmpipe synth hand-photographs` (600 x 800 pixels; five skin tones, five backgrounds, uneven light, soft shadows, blur,
noise, JPEG; the forearm leaves the picture at the bottom), so that the outline and every place on it are known. A hand, wrist
to finger tips, measures {height:.0f} pixels across its bounding box. They are not real photographs.

```sh
ssmpipe synth hand-photographs data/hands && ssmpipe run configs/hand_photographs.yaml
```

![Outlines found in the first twelve photographs, with start (green) and end (blue)](figures/hand_photographs.png)

## The outline in the picture

Distances between the outline found and the true one, both ways [pixels], first {N_TRACED} pictures; `auto` takes skin here.

{table(["method", "RMS, median", "RMS, worst", "largest, median", "largest, worst", "refused"], found_rows)}
The largest errors are at the bottom of valleys between fingers, where two edges are less than three pixels apart.

## Correspondence

Landmarks: eleven finger tips, valleys and roots, and two points of the wrist, carried from every hand to every other one; all
places: {truth["points"].shape[1]} per hand, those beyond the ends of an outline left out [pixels; in brackets the 95th percentile].

{table(["ends of the outlines", "hands", "landmarks, before", "after", "all places, before", "after"], rows)}
`stem` cuts every outline where it leaves a circle of 1.5 times the largest inscribed radius, around that circle's centre: the same
place of the hand, however much of the arm is seen. With it no landmark and no click is needed.

By landmark:

{table(["landmark", "before", "after"], each)}
The points of the wrist lie near the cut and slide along straight sides, which nothing in the outline fixes.

![First modes before and after](figures/hand_photographs_modes.png)
""",
        encoding="utf-8",
    )


if __name__ == "__main__":
    main()
