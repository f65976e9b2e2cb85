import numpy as np

from ssmpipe.core.mesh.closing import close_openings, weld
from ssmpipe.core.mesh.grid import grid_faces
from ssmpipe.core.mesh.topology import boundary_loops, euler_characteristic, is_manifold
from ssmpipe.core.mesh.trimesh import TriMesh


def sphere_grid(n_u: int, n_v: int) -> TriMesh:
    """Longitude and latitude, both pole rows repeated."""
    u, v = np.meshgrid(2 * np.pi * np.arange(n_u) / n_u, np.linspace(0, np.pi, n_v), indexing="ij")
    points = np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), -np.cos(v)], axis=-1)
    points[:, 0], points[:, -1] = [0, 0, -1], [0, 0, 1]
    return TriMesh(points.reshape(-1, 3), grid_faces(n_u, n_v, periodic_u=True))


def volume(mesh: TriMesh) -> float:
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return float(np.einsum("fd,fd->", a, np.cross(b, c)) / 6)


def test_a_grid_with_two_poles_becomes_a_closed_sphere() -> None:
    sphere = weld(sphere_grid(40, 30))
    assert sphere.n_vertices == 40 * 28 + 2
    assert euler_characteristic(sphere.faces) == 2
    assert is_manifold(sphere.faces)
    assert boundary_loops(sphere.faces) == []
    assert abs(volume(sphere) - 4 / 3 * np.pi) < 0.05


def test_a_tube_gets_two_lids_that_look_outward() -> None:
    turn, height = np.meshgrid(2 * np.pi * np.arange(60) / 60, np.linspace(0, 3, 7), indexing="ij")
    points = np.stack([np.cos(turn), np.sin(turn), height], axis=-1).reshape(-1, 3)
    tube = TriMesh(points, grid_faces(60, 7, periodic_u=True))
    closed = close_openings(tube)
    assert np.array_equal(closed.vertices[: tube.n_vertices], tube.vertices)
    assert euler_characteristic(closed.faces) == 2
    half = np.concatenate([closed.faces[:, [0, 1]], closed.faces[:, [1, 2]], closed.faces[:, [2, 0]]])
    assert len(np.unique(half, axis=0)) == len(half)
    prism = 60 / 2 * np.sin(2 * np.pi / 60) * 3
    assert abs(volume(closed) - prism) < 1e-12
