"""Register a template to meshes with meshmonk at its default settings; runs in an environment of its own.

python register_meshmonk.py OUT.npz TEMPLATE.ply TARGET.ply ...
"""

import sys
import time

import meshmonk
import numpy as np
import trimesh


def main() -> None:
    """Write the template's vertices on every target, and the seconds that each took."""
    out, *paths = sys.argv[1:]
    template, *targets = (trimesh.load(path, process=False) for path in paths)
    points, seconds = [], []
    for target in targets:
        begin = time.perf_counter()
        result = meshmonk.pyramid_register(floating=template, target=target, compute_normals_flag=True, rigid_params={})
        seconds.append(time.perf_counter() - begin)
        points.append(np.asarray(result.aligned_vertices, dtype=np.float64))
    np.savez(out, points=np.stack(points), seconds=np.array(seconds))


if __name__ == "__main__":
    main()
