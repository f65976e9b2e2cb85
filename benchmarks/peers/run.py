"""Compare ssmpipe with meshmonk and gias3 on full femora whose correspondence is known.

    python -m benchmarks.peers.run [--work FOLDER] [--n 12] [--seed 0] [--tools truth,meshmonk,gias3,ssmpipe]

Every tool gets the same meshes. The vertices of the first one, the template, are carried to all others by each tool's
correspondence and compared with where they truly belong; the template itself is left out. Peers run at their default settings, each in a
virtual environment that this script makes, and so does ssmpipe with the preset ``closed``.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import time
import venv
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.common import head
from benchmarks.peers.cohort import PeerCohort, download, make_cohort
from ssmpipe.core.align.procrustes import generalized_procrustes
from ssmpipe.core.arrays import Floats
from ssmpipe.core.evaluation.measures import generalization, specificity
from ssmpipe.core.mesh.distance import interpolate, point_to_mesh
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.io.arrays import read_npz
from ssmpipe.io.meshes import read_mesh

N_MODES = 3
Tool = Callable[[PeerCohort, Path], tuple[Floats, float]]
"""Takes the cohort and a scratch folder; gives the template's vertices on every shape and the seconds per shape."""


def environment(folder: Path, *packages: str) -> Path:
    """Return the bin folder of a virtual environment that holds ``packages``."""
    binaries = folder / "bin"
    if not (folder / "ready").is_file():
        venv.create(folder, with_pip=True, clear=True)
        plain = [p for p in packages if not p.startswith("!")]
        bare = [p[1:] for p in packages if p.startswith("!")]
        pip = [str(binaries / "python"), "-m", "pip", "install", "--quiet"]
        subprocess.run([*pip, *plain], check=True)
        if bare:
            subprocess.run([*pip, "--no-deps", *bare], check=True)
        (folder / "ready").touch()
    return binaries


def scans(cohort: PeerCohort) -> list[str]:
    return [str(cohort.folder / f"{i}.ply") for i in cohort.ids]


def truth(cohort: PeerCohort, scratch: Path) -> tuple[Floats, float]:
    """Return the true correspondence."""
    return cohort.template_truth, 0.0


def meshmonk(cohort: PeerCohort, scratch: Path) -> tuple[Floats, float]:
    """Register with meshmonk: rigid, then its pyramid of nonrigid rounds."""
    python = environment(scratch.parent.parent / "venv-meshmonk", "meshmonk==0.3.0", "trimesh") / "python"
    out = scratch / "points.npz"
    script = Path(__file__).with_name("register_meshmonk.py")
    subprocess.run([str(python), str(script), str(out), *scans(cohort)], check=True)
    arrays = read_npz(out, ("points", "seconds"))
    first = read_mesh(cohort.folder / f"{cohort.ids[0]}.ply").vertices
    return np.concatenate([first[None], arrays["points"]]), float(arrays["seconds"].mean())


def gias3(cohort: PeerCohort, scratch: Path) -> tuple[Floats, float]:
    """Register with gias3: rigid and scale, then radial basis functions in its two default passes."""
    binaries = environment(
        scratch.parent.parent / "venv-gias3",
        *("gias3.learning", "gias3.mesh", "gias3.registration"),
        *("!gias3", "!gias3.applications", "!gias3.visualisation", "!gias3.io", "!gias3.fieldwork", "!gias3.common"),
    )
    first, *others = scans(cohort)
    points, seconds = [read_mesh(Path(first)).vertices], []
    for target in others:
        out = scratch / Path(target).name
        begin = time.perf_counter()
        command = [str(binaries / "gias-rbfreg"), "-s", first, "-t", target, "-o", str(out)]
        subprocess.run(command, check=True, capture_output=True)
        seconds.append(time.perf_counter() - begin)
        points.append(read_mesh(out).vertices)
    return np.stack(points), float(np.mean(seconds))


def ssmpipe(cohort: PeerCohort, scratch: Path) -> tuple[Floats, float]:
    """Run the whole chain and carry the template's vertices over the corresponded surfaces."""
    config = scratch / "config.yaml"
    config.write_text(
        f"name: peers\ninput:\n  scans: {cohort.folder.resolve()}/*.ply\n  units: mm\noutput: {scratch / 'out'}\nanatomy: closed\n"
    )
    begin = time.perf_counter()
    subprocess.run([sys.executable, "-m", "ssmpipe", "run", str(config)], check=True, stdout=subprocess.DEVNULL)
    seconds = (time.perf_counter() - begin) / len(cohort.ids)
    arrays = read_npz(scratch / "out/cohort/optimize/correspondence.npz", ("ids", "points_scan", "faces"))
    if tuple(arrays["ids"].tolist()) != cohort.ids:
        raise SystemExit(f"only {', '.join(arrays['ids'].tolist())} finished")
    surfaces = [TriMesh(points, arrays["faces"]) for points in arrays["points_scan"]]
    template = read_mesh(cohort.folder / f"{cohort.ids[0]}.ply").vertices
    _, face, weights = point_to_mesh(template, surfaces[0])
    return np.stack([interpolate(s.vertices, s, face, weights) for s in surfaces]), seconds


TOOLS: dict[str, Tool] = {"truth": truth, "meshmonk": meshmonk, "gias3": gias3, "ssmpipe": ssmpipe}


def measure(points: Floats, cohort: PeerCohort) -> tuple[float, float, float, float, float]:
    """Return mean, median and 95th percentile of the error, then generalization and specificity with three modes [mm]."""
    error = np.linalg.norm(points - cohort.template_truth, axis=-1)[1:]
    pose = generalized_procrustes(points, np.full(points.shape[1], 1 / points.shape[1]), remove_size=False)
    aligned = points @ np.swapaxes(pose.rotation, 1, 2) + pose.translation[:, None]
    general = generalization(aligned, N_MODES)[0][-1]
    specific = specificity(aligned, N_MODES, n_samples=1000, rng=np.random.default_rng(0))[0][-1]
    return (
        float(error.mean()),
        float(np.median(error)),
        float(np.quantile(error, 0.95)),
        float(general),
        float(specific),
    )


def main() -> None:
    """Make the cohorts, run the tools, print one table per cohort."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--work", type=Path, default=Path("peers-work"), help="scratch folder; environments stay there")
    parser.add_argument("--n", type=int, default=12, help="femora")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tools", default=",".join(TOOLS))
    options = parser.parse_args()
    work = options.work.resolve()
    wheel = download(work / "wheel")
    head(f"{options.n} full femora, seed {options.seed}, template vertices against truth [mm]")
    for normalize in (False, True):
        name = "normalized" if normalize else "sizes"
        cohort = make_cohort(work / name / "scans", wheel, n_shapes=options.n, seed=options.seed, normalize=normalize)
        print("all sizes equal" if normalize else "sizes as they are")
        print(
            f"{'tool':10} {'mean':>7} {'median':>7} {'p95':>7} {'generalization':>15} {'specificity':>12} {'s per shape':>12}"
        )
        for tool in options.tools.split(","):
            scratch = work / name / tool
            shutil.rmtree(scratch, ignore_errors=True)
            scratch.mkdir(parents=True)
            points, seconds = TOOLS[tool](cohort, scratch)
            mean, median, high, general, specific = measure(points, cohort)
            print(
                f"{tool:10} {mean:7.2f} {median:7.2f} {high:7.2f} {general:15.2f} {specific:12.2f} {seconds:12.1f}",
                flush=True,
            )
        print()


if __name__ == "__main__":
    main()
