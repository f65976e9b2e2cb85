"""One file per mesh format: bytes in, vertices and triangles out; nothing is allocated on the word of a header."""
