"""Are groups of shapes different, where, and by how much: permutation inference on corresponded points."""
