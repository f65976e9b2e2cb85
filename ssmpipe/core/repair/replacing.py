"""Close the holes that a local repair opened, and check that the topology is what it should be."""

from __future__ import annotations

from ssmpipe.core.arrays import Ints
from ssmpipe.core.errors import GeometryError, TopologyError
from ssmpipe.core.mesh.topology import boundary_loops, euler_characteristic
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.filling import fill
from ssmpipe.core.repair.stump import same_points


def new_loops(torn: TriMesh, before: TriMesh) -> list[Ints]:
    """Return the boundary loops of a mesh that an earlier state of it did not have."""
    old = [before.vertices[loop] for loop in boundary_loops(before.faces)]
    loops = boundary_loops(torn.faces)
    return [loop for loop in loops if not any(same_points(torn.vertices[loop], place) for place in old)]


def closed_again(torn: TriMesh, before: TriMesh, euler: int) -> TriMesh:
    """Fill all loops that ``before`` did not have; with the flattest patch where another one would fold.

    Parameters
    ----------
    torn, before : TriMesh
    euler : int
        Euler characteristic that the result must have.

    Raises
    ------
    TopologyError
        If it has another one, or another number of boundary loops than ``before``.
    GeometryError
        If even the flattest patches would fold.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import sphere
    >>> from ssmpipe.core.mesh.topology import compact
    >>> ball = sphere(10.0, 3)
    >>> torn = compact(ball, ~(ball.faces == 7).any(axis=1))
    >>> boundary_loops(closed_again(torn, ball, euler=2).faces)
    []
    """
    loops = new_loops(torn, before)
    try:
        result = fill(torn, loops)[0]
    except GeometryError:
        result = fill(torn, loops, method="membrane")[0]
    same = len(boundary_loops(result.faces)) == len(boundary_loops(before.faces))
    if euler_characteristic(result.faces) != euler or not same:
        raise TopologyError("closing the holes of a local repair would change the topology")
    return result
