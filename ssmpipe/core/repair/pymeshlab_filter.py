"""One filter of PyMeshLab on one mesh, loaded only when it is asked for."""

from __future__ import annotations

from typing import Any

import numpy as np

from ssmpipe.core.errors import ConfigError
from ssmpipe.core.mesh.trimesh import TriMesh


def pymeshlab_filter(mesh: TriMesh, name: str, **parameters: Any) -> TriMesh:
    """Run a filter of PyMeshLab (Cignoni et al. 2008) and return the mesh it leaves.

    Parameters
    ----------
    mesh : TriMesh
    name : str
        Name of the filter.
    **parameters
        All parameters of the filter: one that is left out would take the value of the previous call in this process.

    Raises
    ------
    ConfigError
        If PyMeshLab or the filter cannot be loaded.
    """
    remedy = "install pymeshlab and the system packages libgl1 and libopengl0, or use another method"
    try:
        import pymeshlab
    except ImportError as error:
        raise ConfigError(f"PyMeshLab cannot be loaded ({error})", remedy) from error
    work = pymeshlab.MeshSet()
    work.add_mesh(pymeshlab.Mesh(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int32)))
    try:
        work.apply_filter(name, **parameters)
    except pymeshlab.PyMeshLabException as error:
        raise ConfigError(f"the filter {name} of PyMeshLab failed ({error})", remedy) from error
    result = work.current_mesh()
    return TriMesh(np.array(result.vertex_matrix()), np.array(result.face_matrix(), dtype=np.int64))
