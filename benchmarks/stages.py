"""Time and peak memory of every mesh stage on 70 thousand and 700 thousand faces, default options unless the row says otherwise.

Every cell runs in a process of its own, so that the peak belongs to it alone (it includes the interpreter, the libraries and the
input, 0.1 to 0.2 GB). Inputs are made by marching cubes, with their slivers: a lump for closed surfaces, the same lump cut for disks,
a tube with three bulges for tubes.

    python -m benchmarks.stages [--faces 70000 700000] [--only NAME ...] [--timeout SECONDS] [--memory GB]
"""

from __future__ import annotations

import argparse
import logging
import multiprocessing
import resource
import time
from collections.abc import Callable
from importlib import import_module
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import igl
import numpy as np

from benchmarks.common import head
from ssmpipe.contract import Context, ShapeInfo
from ssmpipe.core.align.rigid import homogeneous, move, rotation_vector_matrix
from ssmpipe.core.arrays import Floats
from ssmpipe.core.mesh.topology import boundary_loops, compact
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.cleaning import clean
from ssmpipe.core.repair.trimming import cut_by_plane, trim

Inputs = dict[str, Any]
FACES_PER_CELL = {"lump": 3.7, "tube": 2.35}
"""Faces over the square of the number of cells along an edge of the cube; found by trying."""


def lump(p: Floats) -> Floats:
    """Return the signed value of a lump of 25 to 45 mm without any symmetry."""
    direction = np.array([[0.1, 0.2, 1.0], [1.0, 0.3, -0.4], [-0.5, 1.0, -0.6], [0.3, -1.0, -0.2]])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    length = np.linalg.norm(p, axis=1) + 1e-9
    cosine = p @ direction.T / length[:, None]
    radius = 28.0 + (np.exp(np.array([6.0, 9.0, 12.0, 10.0]) * (cosine - 1)) * [18.0, 8.0, 6.0, -4.0]).sum(axis=1)
    return np.asarray(length - radius)


def bulged(p: Floats) -> Floats:
    """Return the signed value of a tube about the z axis with three bulges, radius 13 to 16 mm, open at both ends."""
    angle = np.arctan2(p[:, 1], p[:, 0])
    radius = 13.0 + 3.0 * np.exp(-((p[:, 2] + 15.0) ** 2) / 60.0) * (0.6 + 0.4 * np.cos(3 * angle))
    return np.asarray(np.hypot(p[:, 0], p[:, 1]) - radius)


def marched(function: Callable[[Floats], Floats], reach: float, n: int) -> TriMesh:
    t = np.linspace(-reach, reach, n)
    z, y, x = np.meshgrid(t, t, t, indexing="ij")
    grid = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    vertices, faces, _ = igl.marching_cubes(function(grid), grid, n, n, n, 0.0)
    return clean(TriMesh(vertices, faces)).mesh


def surface(kind: str, n_faces: int) -> TriMesh:
    """Return a lump or a tube of about so many faces; more than 200 thousand by dividing every face of a coarser one into four."""
    if n_faces > 200_000:
        coarse = surface(kind, n_faces // 4)
        fine = TriMesh(*igl.upsample(coarse.vertices, coarse.faces, 1))
        around = np.array([1.0, 1.0, 1.0 if kind == "lump" else 0.0])
        length = np.linalg.norm(fine.vertices * around, axis=1, keepdims=True)
        off = (lump if kind == "lump" else bulged)(fine.vertices)[:, None]
        return TriMesh(fine.vertices - off * fine.vertices * around / length, fine.faces)
    n = round(np.sqrt(n_faces / FACES_PER_CELL[kind]))
    return marched(lump, 48.0, n) if kind == "lump" else marched(bulged, 45.0, n)


def soup(mesh: TriMesh) -> TriMesh:
    return TriMesh(mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(3 * mesh.n_faces).reshape(-1, 3))


def turned(mesh: TriMesh) -> TriMesh:
    return move(mesh, homogeneous(rotation_vector_matrix(np.array([0.4, -0.9, 1.3])), np.array([30.0, -20.0, 50.0])))


def pierced(mesh: TriMesh) -> TriMesh:
    """Return a tube with three holes of 7 mm radius."""
    near = np.zeros(mesh.n_vertices, dtype=bool)
    for angle, z in ((0.0, -15.0), (2.1, 5.0), (4.2, 25.0)):
        middle = np.array([14.0 * np.cos(angle), 14.0 * np.sin(angle), z])
        near |= np.linalg.norm(mesh.vertices - middle, axis=1) < 7.0
    return compact(mesh, ~near[mesh.faces].any(axis=1))


def disk(mesh: TriMesh) -> TriMesh:
    return trim(mesh, np.zeros(3), np.array([0.0, 0.0, -1.0]))


def tube(mesh: TriMesh) -> TriMesh:
    return cut_by_plane(
        cut_by_plane(mesh, np.array([0, 0, 40.0]), np.array([0, 0, 1.0])),
        np.array([0, 0, -40.0]),
        np.array([0, 0, -1.0]),
    )


def opened(mesh: TriMesh) -> Inputs:
    """Return a tube and its seam."""
    return go("cut", {"mesh": tube(mesh)}, {"seam_direction": (0.0, 1.0, 0.0)})[0]


def moved(mesh: TriMesh) -> Inputs:
    return {"mesh": turned(mesh), "transform": np.eye(4), "reference": mesh}


def mapped(mesh: TriMesh) -> Inputs:
    made = go("parameterize", {"mesh": disk(mesh)}, {})[0]
    return {"mesh": made["mesh"], "uv": made["uv"]}


def sampled(mesh: TriMesh) -> Inputs:
    inputs = mapped(mesh)
    return {"samples": go("sample", inputs, {})[0]["samples"], "mesh": inputs["mesh"]}


CELLS: dict[str, tuple[str, str, Callable[[TriMesh], Inputs], dict[str, Any]]] = {
    "repair, STL soup": ("lump", "repair", lambda m: {"mesh": soup(m)}, {}),
    "orient, box": (
        "lump",
        "orient",
        lambda m: {"mesh": turned(m), "transform": np.eye(4), "info": ShapeInfo("a")},
        {"frame": "box"},
    ),
    "fill-holes, 3 of 14 mm": ("tube", "fill-holes", lambda m: {"mesh": pierced(m)}, {"keep_openings": 2}),
    "trim, plane": ("lump", "trim", lambda m: {"mesh": m}, {"axis_fraction": 0.6}),
    "trim, both ends of a tube": ("tube", "trim", lambda m: {"mesh": m}, {"ends": 2}),
    "smooth, taubin": ("lump", "smooth", lambda m: {"mesh": m}, {}),
    "smooth, bilaplacian": ("lump", "smooth", lambda m: {"mesh": m}, {"method": "bilaplacian"}),
    "decimate, fast-simplification": ("lump", "decimate", lambda m: {"mesh": m}, {}),
    "decimate, qslim": ("lump", "decimate", lambda m: {"mesh": m}, {"method": "qslim"}),
    "align": ("lump", "align", moved, {}),
    "cut, edges": ("tube", "cut", lambda m: {"mesh": tube(m)}, {"seam_direction": (0.0, 1.0, 0.0)}),
    "cut, geodesic": (
        "tube",
        "cut",
        lambda m: {"mesh": tube(m)},
        {"seam_direction": (0.0, 1.0, 0.0), "path": "geodesic"},
    ),
    "parameterize, disk": ("lump", "parameterize", lambda m: {"mesh": disk(m)}, {}),
    "parameterize, tube": ("tube", "parameterize", opened, {}),
    "parameterize, cone": ("lump", "parameterize", lambda m: {"mesh": disk(m)}, {"topology": "cone"}),
    "parameterize, closed": ("lump", "parameterize", lambda m: {"mesh": m}, {"topology": "closed"}),
    "sample, 200 x 200": ("lump", "sample", mapped, {}),
    "fit": ("lump", "fit", sampled, {}),
}


def go(stage: str, inputs: Inputs, options: dict[str, Any]) -> tuple[Inputs, list[str]]:
    module = import_module(f"ssmpipe.stages.{stage.replace('-', '_')}")
    ctx = Context("shape", np.random.default_rng(0), logging.getLogger("benchmark"))
    return module.run(**inputs, cfg=module.Config(**options), ctx=ctx), ctx.warnings


def peak_memory() -> float:
    """Return the largest resident memory of this process [GB]; that of getrusage would count its parent before the start."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1]) / 1e6


def child(sender: Connection, stage: str, inputs: Inputs, options: dict[str, Any], memory: float) -> None:
    logging.disable()
    resource.setrlimit(resource.RLIMIT_DATA, (int(memory * 1e9), int(memory * 1e9)))
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        go(stage, inputs, options)
        error = ""
    except Exception as failure:  # the table says which cell failed
        error = f"{type(failure).__name__}: {failure}"
    peak = peak_memory()
    sender.send((time.perf_counter() - wall, time.process_time() - cpu, peak, error))


def measure(
    stage: str, inputs: Inputs, options: dict[str, Any], timeout: float, memory: float
) -> tuple[float, float, float, str]:
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=child, args=(sender, stage, inputs, options, memory))
    process.start()
    sender.close()
    answer = (timeout, timeout, 0.0, f"more than {timeout:.0f} s")
    if receiver.poll(timeout):
        try:
            answer = receiver.recv()
        except EOFError:
            answer = (0.0, 0.0, 0.0, "the process died")
    else:
        process.kill()
    process.join()
    return answer


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--faces", type=int, nargs="+", default=[70_000, 700_000])
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--timeout", type=float, default=300.0)
    parser.add_argument("--memory", type=float, default=8.0, help="a cell that asks for more [GB] has failed")
    arguments = parser.parse_args()
    head("Mesh stages")
    names = [name for name in CELLS if not arguments.only or any(part in name for part in arguments.only)]
    rows: dict[str, list[str]] = {name: [] for name in names}
    for n_faces in arguments.faces:
        kinds = {kind: surface(kind, n_faces) for kind in sorted({CELLS[name][0] for name in names})}
        for kind, mesh in kinds.items():
            print(f"{kind}: {mesh.n_faces} faces, {len(boundary_loops(mesh.faces))} openings", flush=True)
        for name in names:
            kind, stage, made, options = CELLS[name]
            wall, cpu, peak, error = measure(stage, made(kinds[kind]), options, arguments.timeout, arguments.memory)
            print(f"  {name}: {wall:.1f} s wall, {cpu:.1f} s CPU, {peak:.2f} GB {error}", flush=True)
            rows[name] += [error] * 3 if error else [f"{wall:.1f}", f"{cpu:.1f}", f"{peak:.2f}"]
    sizes = [f"{n:,} faces, wall [s] | CPU [s] | peak [GB]".replace(",", " ", 1) for n in arguments.faces]
    print("\n| stage | " + " | ".join(sizes) + " |\n|---|" + "---|" * (3 * len(sizes)))
    for name, row in rows.items():
        print(f"| {name} | " + " | ".join(row) + " |")


if __name__ == "__main__":
    main()
