"""Maps from a disk-like mesh to the unit square."""
