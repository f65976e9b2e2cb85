"""What a stage is: ports, options, a run function, and the context it may use.

A stage file under ``ssmpipe/stages`` defines ``class Config(StageConfig)``, ``def run(...)`` and ``STAGE = Stage(...)``.
``run`` takes one keyword argument per input port (the artifact, or ``None`` for an absent optional one) plus ``cfg``
and ``ctx``, and returns a dict with one entry per output port. In a stage of scope ``cohort`` every per-shape input
arrives as ``dict[shape_id, artifact]`` in sorted order.

Artifacts by slot:

================  ===========================================================================  ==================
slot              Python object                                                                file
================  ===========================================================================  ==================
mesh              :class:`ssmpipe.core.mesh.trimesh.TriMesh`                                   mesh.ply (float64)
contour           :class:`ssmpipe.core.outline.outline.Outline`                                contour.csv
image             :class:`ssmpipe.core.outline.picture.Picture`, as it is in the scan          (never written)
landmarks         :class:`Landmarks`                                                           landmarks.json
transform         (4, 4) float64, scan coordinates to the current frame [mm]                   transform.json
info              :class:`ShapeInfo`                                                           info.json
seam              :class:`ssmpipe.core.parameterize.seam.Seam`, for what is not a disk         seam.npz
uv                (n_vertices, 2) float64, one row per mesh vertex; unit square, period 1      uv.npz
                  in u where there is a seam
samples           (n_u, n_v, 3) float64                                                        samples.npz
surface           :class:`ssmpipe.core.spline.surface.BSplineSurface` or BSplineCurve          surface.npz
reference         what all shapes are aligned to, TriMesh or Outline; by ``Stage.prepare``     reference.ply, .csv
chain             :class:`ssmpipe.core.model.shape_model.Chain`, from the runner               (never written)
correspondence    :class:`ssmpipe.core.correspondence.correspondence.Correspondence`           correspondence.npz
certificate       dict, kind ``json``                                                          certificate.json
history           :class:`Table`                                                               history.csv
model             :class:`ssmpipe.core.model.shape_model.ShapeModel`                           model.npz, model.h5
scores, measures  :class:`Table`                                                               scores.csv ...
any               dict name -> TriMesh or Outline, kind ``meshes``                             <name>.ply or .csv
any               dict name -> array, kind ``arrays``                                          <slot>.npz
================  ===========================================================================  ==================
"""

from __future__ import annotations

import difflib
import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from ssmpipe.core.arrays import Floats
from ssmpipe.core.checkpoints import Checkpoints
from ssmpipe.core.engine import Engine
from ssmpipe.core.errors import LandmarkError

Scope = Literal["shape", "cohort"]


class StageConfig(BaseModel):
    """Options of one stage: frozen, strict, nothing unknown allowed; every field has a description with its unit."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")


@dataclass(frozen=True)
class NamesShape:
    """Mark of an option whose value is a shape id, in its ``Annotated`` type; ``words`` may stand for one.

    For a prepared slot of the same name the value may be a file as well. The runner checks it before anything runs.
    """

    words: tuple[str, ...] = ()


@dataclass(frozen=True)
class Landmarks:
    """Named points of one shape, in the current frame [mm], and which name serves which role.

    Examples
    --------
    >>> marks = Landmarks({"MFH": np.zeros(3)}, {"apex": "MFH"})
    >>> marks.role("apex")
    array([0., 0., 0.])
    >>> marks.role("seam") is None
    True
    >>> Landmarks({"mfh": np.zeros(3), "a": np.zeros(3)}, {"apex": "MFH"}).role("apex")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ...
    ssmpipe.core.errors.LandmarkError: landmark 'MFH' (role 'apex') is missing; this shape has 'mfh' and 1 more; try: ...
    """

    points: Mapping[str, Floats] = field(default_factory=dict)
    roles: Mapping[str, str] = field(default_factory=dict)

    def role(self, role: str) -> Floats | None:
        """Return the point that serves ``role``, or None when no landmark was assigned to it.

        A landmark that bears the role's own name serves it as well.

        Raises
        ------
        LandmarkError
            If a name was assigned to the role but this shape has no such landmark.
        """
        name = self.roles.get(role, role)
        if name in self.points:
            return self.points[name]
        if role in self.roles:
            raise LandmarkError(
                f"landmark '{name}' (role '{role}') is missing; this shape has {self._others(name)}",
                f"add it to the landmark file, or remove input.roles.{role} to let geometry decide",
            )
        return None

    def _others(self, name: str) -> str:
        """Return what there is instead of ``name``: the closest one, or a few."""
        names = sorted(self.points)
        close = difflib.get_close_matches(name.lower(), [n.lower() for n in names], n=1)
        if close:
            best = next(n for n in names if n.lower() == close[0])
            return f"'{best}'" + (f" and {len(names) - 1} more" if len(names) > 1 else "")
        more = f" and {len(names) - 3} more" if len(names) > 3 else ""
        return ", ".join(f"'{n}'" for n in names[:3]) + more if names else "none"

    def transformed(self, matrix: Floats) -> Landmarks:
        """Return the landmarks moved by a (4, 4) homogeneous ``matrix``; planar ones by its part in the plane."""
        moved = {name: matrix[: len(p), : len(p)] @ p + matrix[: len(p), 3] for name, p in self.points.items()}
        return Landmarks(moved, self.roles)


@dataclass(frozen=True)
class ShapeInfo:
    """What the cohort table says of one shape: ``side`` is "L", "R" or None; ``columns`` holds the rest as text."""

    id: str
    side: str | None = None
    columns: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Table:
    """Columns of equal length, written as CSV; ``comment`` becomes a first line that starts with ``#``."""

    columns: Mapping[str, Sequence[Any]]
    comment: str = ""


@dataclass(frozen=True)
class Port:
    """A named input or output of a stage; ``volatile`` outputs hold timings and stay out of all digests.

    ``columns`` of an ``info`` input are those of the cohort table that the stage reads, None for all: a change of another one
    is nothing to it.
    """

    slot: str
    kind: str
    optional: bool = False
    volatile: bool = False
    columns: tuple[str, ...] | None = None


@dataclass
class Context:
    """All that a running stage may use besides its inputs and options.

    Attributes
    ----------
    rng : numpy.random.Generator
        Seeded from the run's seed, the shape id and the stage; never from the clock.
    metrics : dict
        Numbers for the report; keys end in a unit (``rms_mm``) or are counts (``n_faces``). Where lengths have no unit, the runner
        stores ``rms_unit``.
    warnings : list of str
    progress : callable
        ``progress(done, total, text)``; shown as a bar on a terminal.
    checkpoints : Checkpoints, optional
        For long group stages: where their state goes, and the state to continue from.
    engine : Engine, optional
        For large group stages: processes that share the work; the result may not depend on them.
    threads : int
        That a group stage may use; the result may not depend on their number.
    unit : str
        Of lengths, for texts: "mm", or "file units" where the config says ``units: none``.
    joins : bool
        Whether the shape joins a finished model, for advice: there is neither a config nor a cohort to change.
    """

    shape_id: str
    rng: np.random.Generator
    log: logging.Logger
    metrics: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    progress: Callable[[int, int, str], None] = field(default=lambda done, total, text: None)
    checkpoints: Checkpoints | None = None
    engine: Engine | None = None
    threads: int = 1
    unit: str = "mm"
    joins: bool = False

    def metric(self, name: str, value: Any) -> None:
        """Record a number (or short text, or list) for the manifest and the report."""
        self.metrics[name] = value

    def warn(self, message: str) -> None:
        """Record a warning that names a fact and a remedy; shown in the console, the log and the report."""
        self.warnings.append(message)
        self.log.warning(message)


@dataclass(frozen=True)
class Stage:
    """Declaration of a stage.

    Parameters
    ----------
    name : str
        Name in configs and on the command line; the file is ``stages/<name with underscores>.py``.
    scope : {"shape", "cohort"}
    version : int
        Raised when the numbers change; part of the fingerprint.
    config : type of StageConfig
    run : callable
    inputs, outputs : tuple of Port
        The first input and first output are the main file of the single-file command.
    methods : str or callable
        Sentence for the methods paragraph; ``{option}`` is replaced by the option's value. Or ``methods(options) -> str``, where
        options decide what is to be said.
    cites : tuple of str
        Keys into the bibliography of the report.
    prepare : callable, optional
        ``prepare(inputs: dict[shape_id, dict[slot, artifact]], *, cfg, ctx) -> dict[slot, artifact]``: runs once for the
        cohort before the per-shape runs and makes the inputs that are common to all (the reference of ``align``).
        The slots that it makes are listed in ``prepared``.
    prepared : tuple of Port
    roles : tuple of str
        Roles of landmarks that the stage reads.
    variants : tuple of Stage
        The same stage, by the same name and scope, for other kinds of input, with options and ports of their own.
    """

    name: str
    scope: Scope
    version: int
    config: type[StageConfig]
    run: Callable[..., dict[str, Any]]
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    methods: str | Callable[[Mapping[str, Any]], str] = ""
    cites: tuple[str, ...] = ()
    prepare: Callable[..., dict[str, Any]] | None = None
    prepared: tuple[Port, ...] = ()
    roles: tuple[str, ...] = ()
    variants: tuple[Stage, ...] = ()

    def suiting(self, slots: Collection[str]) -> Stage:
        """Return this stage or the first of its variants whose required inputs are among ``slots``; itself if none is.

        Examples
        --------
        >>> flat = Stage("a", "shape", 1, StageConfig, dict, (Port("contour", "outline"),), ())
        >>> solid = Stage("a", "shape", 1, StageConfig, dict, (Port("mesh", "trimesh"),), (), variants=(flat,))
        >>> solid.suiting({"contour"}) is flat, solid.suiting({"mesh"}) is solid
        (True, True)
        """
        for stage in (self, *self.variants):
            ready = {port.slot for port in stage.prepared}
            if all(port.optional or port.slot in ready or port.slot in slots for port in stage.inputs):
                return stage
        return self
