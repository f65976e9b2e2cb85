"""Surface files in and out, guarded: a bad file ends in one line that says what is wrong with it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import ArtifactError, GeometryError
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.io.mesh_formats import obj, off, ply, stl, vtk, vtp
from ssmpipe.io.mesh_formats.polygons import EXPORT_AGAIN

_PARSERS = {
    ".stl": stl.parse, ".ply": ply.parse, ".obj": obj.parse, ".off": off.parse, ".vtk": vtk.parse, ".vtp": vtp.parse,
}  # fmt: skip

MESH_SUFFIXES = tuple(_PARSERS)
"""Suffixes that :func:`read_mesh` accepts, in lower case."""

MAX_BYTES = 2**31
MAX_FACES = 20_000_000


def read_mesh(path: Path) -> TriMesh:
    """Read a triangle surface; polygons are cut into triangles, equal corners of an STL are merged.

    Coordinates are taken as they stand in the file: neither units nor RAS/LPS are converted.

    Parameters
    ----------
    path : Path
        ``.stl .ply .obj .off``, legacy ``.vtk`` (PolyData) or ``.vtp``, in upper or lower case.

    Returns
    -------
    TriMesh

    Raises
    ------
    ArtifactError
        With one line that says what is wrong: unknown suffix, empty, truncated, counts that do not fit the file,
        indices out of range, coordinates that are not finite, no faces. The caller adds the path.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in _PARSERS:
        remedy = "extract the surface and save it as .vtp or .ply" if suffix == ".vtu" else "convert it to .ply"
        raise ArtifactError(
            f"'{path.suffix}' is not a surface format that can be read ({' '.join(MESH_SUFFIXES)})", remedy
        )
    data = _read_bytes(path)
    try:
        vertices, faces = _PARSERS[suffix](data)
        if len(faces) > MAX_FACES:
            raise ArtifactError(f"the mesh has {len(faces)} faces, at most {MAX_FACES} are read", "decimate it first")
        return TriMesh(vertices, faces)
    except (GeometryError, ArtifactError) as error:
        fact = "".join(c if c.isprintable() else "?" for c in error.fact)
        raise ArtifactError(fact, error.remedy or EXPORT_AGAIN) from error
    except (Exception, SystemExit) as error:
        text = " ".join(f"{type(error).__name__}: {error}".split())[:160]
        raise ArtifactError(f"not a readable {suffix[1:].upper()} file ({text})", EXPORT_AGAIN) from error


def _read_bytes(path: Path) -> bytes:
    try:
        if not path.is_file():
            raise ArtifactError(
                "there is no such file" if not path.exists() else "this is not a file", "check the path"
            )
        size = path.stat().st_size
        if size == 0:
            raise ArtifactError("the file is empty", EXPORT_AGAIN)
        if size > MAX_BYTES:
            raise ArtifactError(
                f"the file has {size} bytes, at most {MAX_BYTES} are read", "decimate the surface first"
            )
        data = path.read_bytes()
    except OSError as error:
        raise ArtifactError(f"the file cannot be read ({error.strerror or error})", "check its permissions") from error
    head = data[:200].lstrip().lower()
    if head.startswith((b"<!doctype html", b"<html")):
        raise ArtifactError("this is a web page, not a surface", "download the file again, logged in if needed")
    if head.startswith(b"version https://git-lfs"):
        raise ArtifactError("this is a Git LFS pointer, not the surface itself", "run 'git lfs pull'")
    return data


def write_mesh(path: Path, mesh: TriMesh) -> None:
    """Write a surface; the same mesh gives the same bytes.

    Parameters
    ----------
    path : Path
        ``.ply`` and ``.vtp`` (binary, float64, exact), ``.stl`` (binary, float32), ``.obj``, ``.off``.

    Raises
    ------
    ArtifactError
        If the suffix is none of these.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".ply":
        path.write_bytes(ply.dump(mesh.vertices, mesh.faces))
    elif suffix == ".vtp":
        path.write_bytes(vtp.dump(mesh.vertices, mesh.faces))
    elif suffix in (".stl", ".obj", ".off"):
        path.write_bytes(_export(mesh.vertices, mesh.faces, suffix[1:]))
    else:
        raise ArtifactError(
            f"'{path.suffix}' is not a surface format that can be written", "use .ply, .stl, .vtp, .obj or .off"
        )


def _export(vertices: Floats, faces: Ints, kind: str) -> bytes:
    import trimesh  # slow to import: only when needed

    data = trimesh.Trimesh(np.array(vertices), np.array(faces), process=False).export(file_type=kind)
    return data if isinstance(data, bytes) else data.encode()
