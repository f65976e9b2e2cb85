"""Triangle meshes: the frozen mesh, topology, operators, distances."""
