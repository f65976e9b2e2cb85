"""Leave each femur out, build the model of the others, project the one left out, and measure; prints the tables of ``docs/project.md``.

    python docs/make_project.py --data FOLDER [--work FOLDER] [--only ID ...]

FOLDER holds ``scans/*.ply``, ``cohort.csv`` and ``landmarks.json`` of real femora.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from ssmpipe.core.align.rigid import apply, move, rigid_fit
from ssmpipe.core.evaluation.landmark_transfer import landmark_transfer
from ssmpipe.core.mesh.distance import point_to_mesh, signed_point_to_mesh
from ssmpipe.core.mesh.operators import vertex_normals
from ssmpipe.core.mesh.topology import compact
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.io.codecs import read_json
from ssmpipe.io.landmarks import read_landmarks
from ssmpipe.io.meshes import read_mesh, write_mesh
from ssmpipe.io.models import read_model

ROOT = Path(__file__).resolve().parents[1]


def ssmpipe(*arguments: str, may_leave_holes: bool = False) -> None:
    done = subprocess.run([sys.executable, "-m", "ssmpipe", *arguments], capture_output=True, text=True, cwd=ROOT)
    if done.returncode and not (may_leave_holes and done.returncode == 3):
        raise SystemExit(done.stdout + done.stderr)


def build(data: Path, scans: list[Path], out: Path) -> None:
    listed = "[" + ",".join(f'"{p}"' for p in scans) + "]"
    ssmpipe(
        "run", "configs/femur_distal.yaml", "--to", "model", "-q", "--set", f"input.scans={listed}",
        "--set", f"input.cohort={data / 'cohort.csv'}", "--set", f"input.landmarks={data / 'landmarks.json'}", "--set", f"output={out}",
    )  # fmt: skip


def transfer_to(result: Path, held: str, points: np.ndarray, matrix: np.ndarray, marks: dict) -> np.ndarray:
    """Return the errors of all landmarks carried to the held-out shape and from it."""
    with np.load(result / "cohort/optimize/correspondence.npz") as known:
        ids = [*known["ids"].tolist(), held]
        every = np.concatenate([known["points"], points[None]])
        frames = [*known["transform"], matrix]
        faces = known["faces"]
    placed = {
        i: {name: m[:3, :3] @ np.array(p) + m[:3, 3] for name, p in marks[i].items()}
        for i, m in zip(ids, frames, strict=True)
        if i in marks
    }
    errors = []
    for one in landmark_transfer(every, faces, ids, placed, max_distance=8.0):
        if held in one.ids:
            k = one.ids.index(held)
            others = np.arange(len(one.ids)) != k
            errors += [*one.errors[others, k], *one.errors[k, others]]
    return np.array(errors)


def joint_transfer(result: Path, held: str, marks: dict) -> np.ndarray:
    """Return the same errors where all shapes were optimized together."""
    with np.load(result / "cohort/optimize/correspondence.npz") as known:
        ids = known["ids"].tolist()
        placed = {
            i: {name: m[:3, :3] @ np.array(p) + m[:3, 3] for name, p in marks[i].items()}
            for i, m in zip(ids, known["transform"], strict=True)
            if i in marks
        }
        found = landmark_transfer(known["points"], known["faces"], ids, placed, max_distance=8.0)
    errors = []
    for one in found:
        if held in one.ids:
            k = one.ids.index(held)
            others = np.arange(len(one.ids)) != k
            errors += [*one.errors[others, k], *one.errors[k, others]]
    return np.array(errors)


CUTS = {
    "upper half": lambda x, mean: x[:, 2] > np.median(mean[:, 2]),
    "one condyle": lambda x, mean: x[:, 0] > np.quantile(mean[:, 0], 0.65),
    "lateral half": lambda x, mean: x[:, 0] > np.median(mean[:, 0]),
    "medial half": lambda x, mean: x[:, 0] < np.median(mean[:, 0]),
    "hole in front": lambda x, mean: np.linalg.norm(x - mean[mean[:, 1].argmax()], axis=1) < 18.0,
}


def complete_parts(work: Path, held: str, data: Path, only: str = "") -> list[tuple[str, str, float, ...]]:
    """Cut parts off a processed scan, complete what is left by the model of the others, and measure on what was cut off."""
    out, target = work / f"without-{held}", work / f"projected-{held}"
    model = read_model(out / "cohort/model/model.npz")
    scan = read_mesh(target / "patients" / held / "scan.vtp")
    with np.load(target / "patients" / held / "projection.npz") as found:
        matrix, points = found["transform"], found["points"]
    own = move(scan, matrix)
    rows = []
    for name, is_missing in CUTS.items():
        if only and name != only:
            continue
        missing = is_missing(own.vertices, model.mean)
        part = compact(scan, ~missing[scan.faces].any(axis=1))
        folder = work / f"part-{held}-{name.replace(' ', '-')}"
        folder.mkdir(exist_ok=True)
        write_mesh(folder / f"{held}.ply", part)
        ssmpipe(
            "project", str(out), str(folder / f"{held}.ply"), "-o", str(folder / "out"), "--fill", "-q",
            "--cohort", str(data / "cohort.csv"), may_leave_holes=True,
        )  # fmt: skip
        with np.load(folder / "out/patients" / held / "projection.npz") as found:
            completed, deviation, to_model = found["points"], found["deviation"], found["transform"]
        row = read_json(folder / "out/patients" / held / "projection.json")
        placed = move(scan, to_model)
        error = point_to_mesh(placed.vertices[missing], TriMesh(completed, model.faces))[0]
        kept = ~is_missing(points, model.mean)
        mean = apply(rigid_fit(model.mean[kept], points[kept]), model.mean)
        by_mean = point_to_mesh(own.vertices[missing], TriMesh(mean, model.faces))[0]
        gone = is_missing(apply(matrix @ np.linalg.inv(to_model), completed), model.mean)
        normals = vertex_normals(TriMesh(completed, model.faces))
        sure = np.sqrt(((normals * deviation) ** 2).sum(axis=1))
        off = np.abs(signed_point_to_mesh(completed, placed))
        inside = float((off[gone] < 2 * sure[gone]).mean())
        rows.append(
            (
                held,
                name,
                missing.mean(),
                error.mean(),
                np.percentile(error, 95),
                by_mean.mean(),
                inside,
                row["expected_error_mm"],
            )
        )
        print(
            f"| {held} | {name} | {100 * missing.mean():.0f} % | {error.mean():.2f} | {np.percentile(error, 95):.2f} "
            f"| {by_mean.mean():.2f} | {sure[gone].mean():.2f} | {100 * inside:.0f} % |", flush=True,
        )  # fmt: skip
    return rows


def draw(work: Path, held: str, name: str, out: Path) -> None:
    """Write a picture: the fragment, the scan with its hole filled, and how unsure the completed surface is."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    from ssmpipe.report.solid import picture

    folder = work / f"part-{held}-{name.replace(' ', '-')}"
    with np.load(folder / "out/patients" / held / "projection.npz") as found:
        matrix, deviation, completed = found["transform"], found["deviation"], found["points"]
    part = move(read_mesh(folder / f"{held}.ply"), matrix)
    filled = move(read_mesh(folder / "out/patients" / held / "filled.ply"), matrix)
    faces = read_model(work / f"without-{held}/cohort/model/model.npz").faces
    spread = np.sqrt((deviation**2).mean(axis=1))
    limit = float(np.ceil(spread.max()))
    centre = (completed.min(axis=0) + completed.max(axis=0)) / 2
    radius = 1.05 * float(np.linalg.norm(completed - centre, axis=1).max())
    figure = Figure(figsize=(9, 3.4), dpi=110)
    plain = np.tile([0.86, 0.82, 0.74], (max(part.n_vertices, filled.n_vertices), 1))
    shown = (
        ("what was given", part.vertices, part.faces, plain[: part.n_vertices]),
        ("filled", filled.vertices, filled.faces, plain[: filled.n_vertices]),
        (f"standard deviation, 0 to {limit:.0f} mm", completed, faces, colormaps["viridis"](spread / limit)[:, :3]),
    )
    for k, (title, points, cells, colours) in enumerate(shown):
        panel = figure.add_subplot(1, 3, k + 1)
        panel.imshow(
            picture(points, cells, view=(120.0, 15.0), centre=centre, radius=radius, colours=colours, inches=3.0)
        )
        panel.set_title(title, fontsize=9)
        panel.set_axis_off()
    figure.tight_layout()
    figure.savefig(out)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--work", type=Path, default=Path(tempfile.gettempdir()) / "ssmpipe-project")
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument(
        "--parts", action="store_true", help="complete fragments; needs the projections of a former call"
    )
    parser.add_argument("--cut", default="", choices=["", *CUTS], help="one kind of fragment only")
    parser.add_argument("--draw", action="store_true", help="picture of one fragment (--only, --cut) of a former call")
    given = parser.parse_args()
    data, work = given.data.resolve(), given.work.resolve()
    scans = sorted((data / "scans").glob("*.ply"))
    marks = read_landmarks(data / "landmarks.json")
    joint = work / "joint"
    if given.draw:
        draw(work, given.only[0], given.cut, ROOT / "docs/figures/project_completion.png")
        return
    if given.parts:
        print(
            "| left out | missing | share | error | 95 % | mean shape | sd | within 2 sd |\n|---|---|---|---|---|---|---|---|",
            flush=True,
        )
        rows = [
            r
            for p in scans
            if not given.only or p.stem in given.only
            for r in complete_parts(work, p.stem, data, given.cut)
        ]
        for name in sorted({r[1] for r in rows}):
            worse = sum(r[3] > r[5] for r in rows if r[1] == name)
            print(f"{name}: worse than the mean shape {worse} of {sum(r[1] == name for r in rows)} times")
            of = np.array([r[2:7] for r in rows if r[1] == name], dtype=float).mean(axis=0)
            print(
                f"| all | {name} | {100 * of[0]:.0f} % | {of[1]:.2f} | {of[2]:.2f} | {of[3]:.2f} | | {100 * of[4]:.0f} % |"
            )
        return
    build(data, scans, joint)
    print(
        "| left out | projected | joint | to scan | from scan | residual | Mahalanobis (p) | certificate |", flush=True
    )
    print("|---|---|---|---|---|---|---|---|")
    projected, together, rows = [], [], []
    for path in scans:
        held = path.stem
        if given.only and held not in given.only:
            continue
        out = work / f"without-{held}"
        if not out.exists():  # the stages of the others are up to date unless the reference changes
            shutil.copytree(joint, out, ignore=shutil.ignore_patterns("optimize", "model", "evaluate", held))
        build(data, [p for p in scans if p != path], out)
        target = work / f"projected-{held}"
        ssmpipe("project", str(out), str(path), "-o", str(target), "--cohort", str(data / "cohort.csv"), "-q")
        row = read_json(target / "patients" / held / "projection.json")
        with np.load(target / "patients" / held / "projection.npz") as found:
            new = transfer_to(out, held, found["points"], found["transform"], marks)
        old = joint_transfer(joint, held, marks)
        projected.append(new)
        together.append(old)
        rows.append(row)
        print(
            f"| {held} | {new.mean():.2f} | {old.mean():.2f} | {row['to_scan_mean_mm']:.2f} | {row['from_scan_mean_mm']:.2f} "
            f"| {row['residual_rms_mm']:.2f} | {row['mahalanobis']:.1f} ({row['mahalanobis_p']:.2f}) | {row['certificate']['status']} |",
            flush=True,
        )
    new, old = np.concatenate(projected), np.concatenate(together)
    print(
        f"| all | {new.mean():.2f} | {old.mean():.2f} | {np.mean([r['to_scan_mean_mm'] for r in rows]):.2f} "
        f"| {np.mean([r['from_scan_mean_mm'] for r in rows]):.2f} | {np.mean([r['residual_rms_mm'] for r in rows]):.2f} | | |"
    )
    model = read_model(joint / "cohort/model/model.npz")
    print(f"joint model: {len(model.ids)} shapes, {len(model.variances)} modes")


if __name__ == "__main__":
    main()
