"""B-spline surfaces for CAD programs: STEP and IGES, through OpenCASCADE (``pip install 'ssmpipe[cad]'``)."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import ArtifactError
from ssmpipe.core.spline.surface import BSplineSurface

CAD_SUFFIXES = (".step", ".stp", ".iges", ".igs")
_NAME = "shape"
_TIME = re.compile(rb"(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d|\d{8}\.\d{6})")


def write_cad(path: Path, surface: BSplineSurface) -> None:
    """Write one B-spline surface as a face, lengths in mm; the same surface gives the same bytes (no time stamps).

    STEP keeps about 1e-7 mm, IGES about 1e-3 mm.

    Raises
    ------
    ArtifactError
        If OpenCASCADE is not installed, or cannot write the file.
    """
    occ = _opencascade()
    face = occ.BRepBuilderAPI_MakeFace(_geometry(occ, surface), 1e-6)
    if not face.IsDone():
        raise ArtifactError("OpenCASCADE makes no face of this surface", "look at the shape: it may fold")
    if path.suffix.lower() in (".step", ".stp"):
        writer = occ.STEPControl_Writer()
        occ.Interface_Static.SetCVal_s("write.step.product.name", _NAME)
        occ.Interface_Static.SetCVal_s("write.step.unit", "MM")
        writer.Transfer(face.Face(), occ.STEPControl_StepModelType.STEPControl_AsIs)
        done = writer.Write(str(path)) == occ.IFSelect_ReturnStatus.IFSelect_RetDone
    else:
        writer = occ.IGESControl_Writer("MM", 0)
        writer.AddShape(face.Face())
        writer.ComputeModel()
        done = writer.Write(str(path))
    if not done:
        raise ArtifactError(f"OpenCASCADE could not write {path.name}", "check the folder and the free space")
    head, mark, rest = path.read_bytes().partition(b"DATA;")
    if mark:  # IGES files have no such line: their header comes first, in numbered lines
        rest = re.sub(rb"'" + _NAME.encode() + rb" \d+'", b"'" + _NAME.encode() + b"'", rest)
    path.write_bytes(_TIME.sub(lambda time: re.sub(rb"\d", b"0", time.group()), head) + mark + rest)


def cad_points(path: Path, n_u: int, n_v: int) -> Floats:
    """Return points of the first surface of a STEP or IGES file, on an even grid over its parameters, (n_u, n_v, 3) [mm].

    Raises
    ------
    ArtifactError
        If OpenCASCADE is not installed, the file cannot be read, or it holds no surface.
    """
    occ = _opencascade()
    reader = occ.STEPControl_Reader() if path.suffix.lower() in (".step", ".stp") else occ.IGESControl_Reader()
    if reader.ReadFile(str(path)) != occ.IFSelect_ReturnStatus.IFSelect_RetDone or reader.TransferRoots() < 1:
        raise ArtifactError(f"{path.name} is not a readable CAD file")
    faces = occ.TopExp_Explorer(reader.OneShape(), occ.TopAbs_ShapeEnum.TopAbs_FACE)
    if not faces.More():
        raise ArtifactError(f"{path.name} holds no surface")
    found = occ.BRep_Tool.Surface_s(occ.face(faces.Current()))
    u_0, u_1, v_0, v_1 = found.Bounds()
    u, v = np.linspace(u_0, u_1, n_u).tolist(), np.linspace(v_0, v_1, n_v).tolist()
    return np.array([[found.Value(a, b).Coord() for b in v] for a in u])


def _geometry(occ: Any, surface: BSplineSurface) -> Any:
    n_u, n_v = surface.control_points.shape[:2]
    poles = occ.points(1, n_u, 1, n_v)
    for i in range(n_u):
        for j in range(n_v):
            poles.SetValue(i + 1, j + 1, occ.gp_Pnt(*surface.control_points[i, j].tolist()))
    knots = []
    for vector in surface.knot_vectors:
        values, counts = np.unique(vector, return_counts=True)
        reals, whole = occ.reals(1, len(values)), occ.integers(1, len(values))
        for k, (value, count) in enumerate(zip(values.tolist(), counts.tolist(), strict=True)):
            reals.SetValue(k + 1, value)
            whole.SetValue(k + 1, count)
        knots.append((reals, whole))
    (u, u_counts), (v, v_counts) = knots
    return occ.Geom_BSplineSurface(poles, u, v, u_counts, v_counts, *surface.degrees, False, False)


def _opencascade() -> Any:
    """Return the parts of OpenCASCADE that are used, as one namespace; slow to import."""
    from importlib import import_module
    from types import SimpleNamespace

    parts = {
        "BRep": ("BRep_Tool",),
        "BRepBuilderAPI": ("BRepBuilderAPI_MakeFace",),
        "Geom": ("Geom_BSplineSurface",),
        "IFSelect": ("IFSelect_ReturnStatus",),
        "IGESControl": ("IGESControl_Reader", "IGESControl_Writer"),
        "Interface": ("Interface_Static",),
        "Message": ("Message",),
        "STEPControl": ("STEPControl_Reader", "STEPControl_StepModelType", "STEPControl_Writer"),
        "TopAbs": ("TopAbs_ShapeEnum",),
        "TopExp": ("TopExp_Explorer",),
        "TopoDS": ("TopoDS",),
        "gp": ("gp_Pnt",),
    }
    try:
        names = {name: getattr(import_module(f"OCP.{part}"), name) for part in parts for name in parts[part]}
        try:
            arrays = import_module("OCP.collections")
            kinds = arrays.Array1_double, arrays.Array1_int, arrays.Array2_gp_Pnt
        except ImportError:  # before version 8
            standard, points = import_module("OCP.TColStd"), import_module("OCP.TColgp")
            kinds = standard.TColStd_Array1OfReal, standard.TColStd_Array1OfInteger, points.TColgp_Array2OfPnt
    except ImportError as error:
        raise ArtifactError(
            f"STEP and IGES need OpenCASCADE, which cannot be loaded ({error})", "pip install 'ssmpipe[cad]'"
        ) from error
    occ = SimpleNamespace(**names, reals=kinds[0], integers=kinds[1], points=kinds[2])
    occ.face = getattr(occ.TopoDS, "Face_s", None) or occ.TopoDS.Face
    messenger = occ.Message.DefaultMessenger_s()
    for printer in list(messenger.Printers()):
        messenger.RemovePrinter(printer)
    return occ
