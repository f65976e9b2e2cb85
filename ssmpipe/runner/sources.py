"""The scans: found, named, checked, and offered to the chain as its first slots.

The original files are only ever read. A surface becomes the slots ``mesh`` (in mm), ``transform`` (unit factor),
``landmarks`` and ``info``; a planar outline (``.csv``, ``.pts``, ``.asf``) becomes ``contour`` instead of ``mesh``, a photograph or
mask becomes ``image``, a spline file (``.npz``, curve or surface) becomes ``surface``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from ssmpipe.core.errors import ArtifactError, ConfigError, GeometryError, LandmarkError
from ssmpipe.runner.fingerprint import digest, file_digest
from ssmpipe.runner.suggest import count

ID = re.compile(r"(?!\.)[A-Za-z0-9._-]{1,64}")
TO_MM: Mapping[str, float] = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 0.001, "none": 1.0}
PLAUSIBLE_MM = (2.0, 5000.0)
"""Bounding-box diagonal of a scan, from a mouse vertebra to a whole body."""
SPLINE_SUFFIX = ".npz"
OUTLINE_SUFFIXES = (".csv", ".pts", ".asf")
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".pbm", ".pnm", ".webp")
WARN_MM = 5.0
_COMMON = {"transform": "transform", "landmarks": "landmarks", "info": "info"}
KINDS: Mapping[str, Mapping[str, str]] = {
    "mesh": {"mesh": "trimesh", **_COMMON},
    "outline": {"contour": "outline", **_COMMON},
    "image": {"image": "image", **_COMMON},
    "spline": {"surface": "surface", **_COMMON},
}
SIDES = {"l": "L", "left": "L", "r": "R", "right": "R", "": None}
"""What a column `side` may say, in small letters."""


@dataclass(frozen=True)
class Source:
    """One scan and what the config, the cohort table and the landmark file say of it.

    Parameters
    ----------
    id : str
    path : Path
    units : str
        Of the file: a key of ``TO_MM``.
    landmarks : dict of (x, y, z), optional
        In file units; None when the landmark file has no entry for this shape.
    roles : dict of str
    side : {"L", "R", None}
    columns : dict of str
    diagonal_mm : (float, float), optional
        Plausible range of the bounding-box diagonal, and the preset that says so in ``anatomy``.
    tolerance_mm : float
        A landmark farther from its surface than this is refused.
    """

    id: str
    path: Path
    units: str = "mm"
    landmarks: Mapping[str, tuple[float, ...]] | None = None
    roles: Mapping[str, str] = field(default_factory=dict)
    side: str | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    diagonal_mm: tuple[float, float] | None = None
    anatomy: str = ""
    tolerance_mm: float = 20.0

    @property
    def kind(self) -> str:
        """What the file is, by its suffix: ``mesh``, ``outline``, ``image`` or ``spline``."""
        suffix = self.path.suffix.lower()
        named = {"spline": (SPLINE_SUFFIX,), "outline": OUTLINE_SUFFIXES, "image": IMAGE_SUFFIXES}
        return next((kind for kind, suffixes in named.items() if suffix in suffixes), "mesh")

    @property
    def kinds(self) -> Mapping[str, str]:
        """Slots that this source offers, with their kinds."""
        return KINDS[self.kind]

    def digest(self, slot: str, columns: Sequence[str] | None = None) -> str:
        """Return the content digest of a slot, of ``info`` by these ``columns`` alone; an unreadable file raises ArtifactError."""
        factor = TO_MM[self.units]
        if slot == "transform":
            return digest(["unit", factor])
        if slot == "landmarks":
            return digest(["landmarks", dict(self.landmarks or {}), dict(self.roles), factor])
        if slot == "info":
            if columns is not None:
                read = {"side": self.side, **self.columns}
                return digest(["info", self.id, {name: read.get(name) for name in columns}])
            return digest(["info", self.id, self.side, dict(self.columns)])
        try:
            state = self.path.stat()
            return digest(["scan", _scan_digest(self.path, state.st_size, state.st_mtime_ns), factor])
        except OSError as error:
            raise ArtifactError(
                f"the file cannot be read ({error.strerror or error})", "check path and permissions"
            ) from error

    def beside(self) -> dict[str, Any]:
        """Return the slots that are not in the file of the scan: ``transform``, ``landmarks`` and ``info``."""
        import numpy as np

        from ssmpipe.contract import Landmarks, ShapeInfo

        factor = TO_MM[self.units]
        points = {name: factor * np.array(p, dtype=np.float64) for name, p in (self.landmarks or {}).items()}
        return {
            "transform": np.diag([factor, factor, factor, 1.0]),
            "landmarks": Landmarks(points, dict(self.roles)),
            "info": ShapeInfo(self.id, self.side, dict(self.columns)),
        }

    def load(self) -> dict[str, Any]:
        """Read and check the scan; return the artifacts by slot, with warnings under ``"warnings"``.

        Raises
        ------
        SsmpipeError
            If the file is not what its suffix says, its size does not fit the anatomy, or a landmark is far from it.
        """
        factor = TO_MM[self.units]
        common = self.beside()
        marks = common["landmarks"]
        if self.kind == "spline":
            return {"surface": self._spline(factor), **common, "warnings": []}
        if self.kind == "outline":
            from ssmpipe.core.outline.outline import Outline
            from ssmpipe.io.outlines import read_outline

            remarks: list[str] = []
            outline = read_outline(self.path, remarks)
            outline = Outline(outline.points * factor, outline.closed)
            warnings = check_landmarks(outline, marks.points, self.tolerance_mm, self.units)
            return {"contour": outline, **common, "warnings": remarks + warnings}
        if self.kind == "image":
            from ssmpipe.io.images import read_image

            remarks = []
            picture = read_image(self.path, remarks)
            self.check_inside(picture.size)
            return {"image": picture, **common, "warnings": remarks}
        from ssmpipe.core.mesh.trimesh import TriMesh
        from ssmpipe.io.meshes import read_mesh

        mesh = read_mesh(self.path)
        if factor != 1.0:
            mesh = TriMesh(mesh.vertices * factor, mesh.faces)
        check_size(mesh, self.diagonal_mm, self.anatomy, self.units)
        warnings = check_landmarks(mesh, marks.points, self.tolerance_mm, self.units)
        return {"mesh": mesh, **common, "warnings": warnings}

    def check_inside(self, size: tuple[int, int]) -> None:
        """Refuse units of length for a picture of ``size`` (height, width), and landmarks outside of it.

        Raises
        ------
        SsmpipeError
        """
        if self.units != "none":
            raise ConfigError(f"input.units is {self.units}, a picture is measured in pixels", "set input.units: none")
        for name, point in sorted((self.landmarks or {}).items()):
            if len(point) != 2:
                raise LandmarkError(f"landmark '{name}' has {len(point)} coordinates, a picture has 2", "write x,y")
            if not (-1 <= point[0] <= size[1] and -1 <= point[1] <= size[0]):
                raise LandmarkError(
                    f"landmark '{name}' lies at {point[0]:.6g}, {point[1]:.6g}, outside of the {size[1]} x {size[0]} pixels",
                    "give x to the right and y down, in pixels of this file",
                )

    def _spline(self, factor: float) -> Any:
        from dataclasses import replace

        from ssmpipe.io.splines import read_spline

        spline = read_spline(self.path)
        return spline if factor == 1.0 else replace(spline, control_points=spline.control_points * factor)


@lru_cache(maxsize=100_000)
def _scan_digest(path: Path, size: int, mtime_ns: int) -> str:
    """Digest of a file that is not read again in this process while its size and time stay the same."""
    return file_digest(path)


def check_size(mesh: Any, limits: tuple[float, float] | None, anatomy: str, units: str) -> float:
    """Return the bounding-box diagonal [mm]; raise GeometryError when it cannot be this anatomy, naming better units."""
    import numpy as np

    diagonal = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    if limits is None or units == "none" or limits[0] <= diagonal <= limits[1]:
        return diagonal
    raw = diagonal / TO_MM[units]
    fits = [name for name, f in TO_MM.items() if name != "none" and limits[0] <= raw * f <= limits[1]]
    remedy = f"set input.units: {fits[0]}" if fits else "check that the file shows the right bone, and its units"
    raise GeometryError(
        f"bounding box diagonal is {diagonal:.3g} mm, {anatomy} expects {limits[0]:g}-{limits[1]:g} mm", remedy
    )


def landmark_distances(shape: Any, points: Mapping[str, Any]) -> dict[str, float]:
    """Return the distance of every landmark to the surface or outline [mm].

    Raises
    ------
    LandmarkError
        If a landmark has another number of coordinates than the shape.
    """
    import numpy as np

    from ssmpipe.core.mesh.distance import point_to_mesh
    from ssmpipe.core.outline.distance import point_to_segments
    from ssmpipe.core.outline.outline import Outline

    if not points:
        return {}
    names = sorted(points)
    planar = isinstance(shape, Outline)
    odd = [name for name in names if len(points[name]) != (2 if planar else 3)]
    if odd:
        raise LandmarkError(
            f"landmark '{odd[0]}' has {len(points[odd[0]])} coordinates, the shape has {2 if planar else 3}",
            "write x,y for outlines and x,y,z for surfaces",
        )
    places = np.array([points[name] for name in names])
    if planar:
        distances = point_to_segments(places, shape.points, shape.edges)[0]
    else:
        distances = point_to_mesh(places, shape)[0]
    return {name: float(d) for name, d in zip(names, distances, strict=True)}


def check_landmarks(shape: Any, points: Mapping[str, Any], tolerance_mm: float, units: str) -> list[str]:
    """Return warnings for landmarks more than 5 mm off the surface or outline.

    Raises
    ------
    LandmarkError
        If one is farther off than ``tolerance_mm``; with units ``none`` the limit is a twentieth of the scan's diagonal.
    """
    import numpy as np

    limit, warn, unit = tolerance_mm, min(WARN_MM, tolerance_mm), "mm"
    if units == "none":
        corners = shape.vertices if hasattr(shape, "vertices") else shape.points
        limit, unit = 0.05 * float(np.linalg.norm(np.ptp(corners, axis=0))), "file units"
        warn = limit / 4
    distances = landmark_distances(shape, points)
    far = sorted((d, name) for name, d in distances.items() if d > limit)
    if far:
        listed = ", ".join(f"'{name}' is {d:.1f} {unit}" for d, name in reversed(far[-3:]))
        more = f" (and {len(far) - 3} more)" if len(far) > 3 else ""
        raise LandmarkError(
            f"landmark {listed} away from the surface{more}, at most {limit:.3g} is accepted",
            _what_would_fit(shape, points, limit)
            or "check that landmarks and scan belong together and have the same units, or raise input.landmark_tolerance",
        )
    return [
        f"landmark '{name}' is {d:.1f} {unit} away from the surface; check that it belongs to this scan"
        for name, d in distances.items()
        if d > warn
    ]


def _what_would_fit(shape: Any, points: Mapping[str, Any], limit: float) -> str:
    """Say which other units, or which other frame, would bring all landmarks onto the shape; empty when none does, or few are given."""
    import numpy as np

    corners = shape.vertices if hasattr(shape, "vertices") else shape.points
    places = np.array(list(points.values()), dtype=np.float64)
    if len(places) < 3:
        return ""
    reach, extent = (float(np.linalg.norm(np.ptp(x, axis=0))) for x in (corners, places))
    changes: list[tuple[Any, str]] = [
        (f, f"multiply the landmarks by {f:g}: they have other units than the scan")
        for f in (10, 0.1, 100, 0.01, 1000, 0.001)
    ]
    if places.shape[1] == 3:
        turn = np.array([-1.0, -1.0, 1.0])
        changes.append(
            (turn, "change the signs of x and y of the landmarks: one of the files is in RAS, the other in LPS")
        )
    for factor, remedy in changes:
        told = {str(k): place for k, place in enumerate(places * factor)}
        if (
            extent * float(np.abs(factor).max()) > 0.1 * reach
            and max(landmark_distances(shape, told).values()) <= limit
        ):
            return remedy
    return ""


def scan_files(patterns: Sequence[Path], suffixes: Sequence[str]) -> list[Path]:
    """Return the scan files that paths, folders and glob patterns stand for, without doubles, sorted by name.

    Raises
    ------
    ConfigError
        If a path does not exist, or nothing is found.
    """
    found: dict[Path, None] = {}
    for pattern in patterns:
        if any(c in str(pattern) for c in "*?["):
            anchor = Path(pattern.anchor) if pattern.anchor else Path()
            hits = sorted(anchor.glob(str(pattern.relative_to(anchor))))
            hits = [p for p in hits if p.is_file()]
        elif pattern.is_dir():
            hits = sorted(p for p in pattern.iterdir() if p.is_file() and p.suffix.lower() in suffixes)
            pictures = {p.stem for p in hits if p.suffix.lower() in IMAGE_SUFFIXES}
            hits = [p for p in hits if p.suffix.lower() not in (".asf", ".pts") or p.stem not in pictures]
            if not hits:
                raise ConfigError(f"no scans in the folder {pattern}", f"put files of type {' '.join(suffixes)} there")
        elif pattern.exists():
            hits = [pattern]
        else:
            raise ConfigError(
                f"the scan {pattern} does not exist", "check input.scans; paths are relative to the config file"
            )
        if not hits:
            raise ConfigError(f"no scans match {pattern}", "check input.scans; paths are relative to the config file")
        found.update(dict.fromkeys(hits))
    return sorted(found, key=lambda p: (p.stem, str(p)))


def find_sources(
    files: Mapping[str, Path],
    *,
    cohort: Mapping[str, Mapping[str, str]] | None = None,
    landmarks: Mapping[str, Mapping[str, Any]] | None = None,
    **common: Any,
) -> tuple[list[Source], list[str]]:
    """Join scan files, cohort table and landmarks by shape id; return the sources, sorted, and warnings.

    Raises
    ------
    ConfigError
        If a side is neither left nor right.
    """
    sources, warnings = [], []
    for shape_id in sorted(files):
        row = dict(cohort.get(shape_id, {})) if cohort is not None else {}
        if cohort is not None and shape_id not in cohort:
            warnings.append(
                f"{shape_id}: no row in the cohort table{_similar(shape_id, cohort)}; add one, or its side and group stay unknown"
            )
        text = row.pop("side", "").strip()
        if text.lower() not in SIDES:
            raise ConfigError(f"cohort table, shape '{shape_id}': side is '{text}'", "write L or R")
        row.pop("path", None)
        points = (landmarks or {}).get(shape_id)
        if landmarks is not None and points is None:
            warnings.append(
                f"{shape_id}: no landmarks in the landmark file{_similar(shape_id, landmarks)}; stages that need a named one will "
                "refuse it"
            )
        plain = None if points is None else {name: tuple(float(x) for x in p) for name, p in points.items()}
        sources.append(
            Source(shape_id, files[shape_id], landmarks=plain, side=SIDES[text.lower()], columns=row, **common)
        )
    for name, table in (("cohort table", cohort), ("landmark file", landmarks)):
        extra = sorted(set(table or {}) - set(files))
        if extra:
            shown = ", ".join(extra[:3]) + (", ..." if len(extra) > 3 else "")
            warnings.append(
                f"{name}: {len(extra)} {'entry has' if len(extra) == 1 else 'entries have'} no scan ({shown})"
            )
    return sources, warnings + _spellings(landmarks or {})


def _similar(shape_id: str, table: Mapping[str, Any]) -> str:
    """Return in brackets the id of a table that was probably meant: with a suffix, in another case, with fewer zeros."""

    def plain(text: str) -> str:
        bare = re.sub(r"\.(stl|ply|obj|off|vtk|vtp|csv|pts|asf|png|jpe?g|tiff?|npz)$", "", text.strip().lower())
        return re.sub(r"(?<![0-9])0+(?=[0-9])", "", re.sub(r"[^a-z0-9]+", "_", bare))

    meant = [name for name in table if plain(name) == plain(shape_id)]
    return f" (it has '{meant[0]}'; ids are file names without suffix, letter by letter)" if len(meant) == 1 else ""


def _spellings(landmarks: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return a warning for every landmark whose name is written in several ways."""
    ways: dict[str, dict[str, int]] = {}
    for points in landmarks.values():
        for name in points:
            counts = ways.setdefault(" ".join(re.split(r"[\s_-]+", name.strip().lower())), {})
            counts[name] = counts.get(name, 0) + 1
    return [
        "landmark file: "
        + ", ".join(f"'{name}' ({count(n, 'shape')})" for name, n in sorted(counts.items()))
        + " are taken for different landmarks; write them alike"
        for _, counts in sorted(ways.items())
        if len(counts) > 1
    ]


def by_id(paths: Sequence[Path]) -> dict[str, Path]:
    """Return shape id (file name without suffix) to path.

    Raises
    ------
    ConfigError
        If a name cannot serve as id, or two files have the same.
    """
    files: dict[str, Path] = {}
    odd = [path.name for path in paths if not ID.fullmatch(path.stem)]
    if odd:
        more = f" (nor can {len(odd) - 1} other{'s' if len(odd) > 2 else ''})" if len(odd) > 1 else ""
        raise ConfigError(
            f"'{odd[0]}' cannot serve as shape id{more}",
            "use up to 64 letters, digits, '.', '_' or '-', no leading '.', as file names; or leave input.scans out and give the cohort "
            "table the columns id and path",
        )
    for path in paths:
        shape_id = path.stem
        if shape_id in files:
            raise ConfigError(f"two scans have the id '{shape_id}': {files[shape_id]} and {path}", "rename one of them")
        files[shape_id] = path
    return files
