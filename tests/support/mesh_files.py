"""Surface files of every format but VTP: odd ones that are valid, hostile ones with the words that refuse them."""

from __future__ import annotations

import struct

import numpy as np

V = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]) * 10 / 3
F = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
V32 = V.astype(np.float32).astype(np.float64)


def rows(array: np.ndarray, prefix: str = "") -> str:
    return "".join(prefix + " ".join(repr(x) for x in row) + "\n" for row in array.tolist())


def stl_binary(header: bytes = b"", count: int | None = None, vertices: np.ndarray = V) -> bytes:
    corners = vertices[F].astype("<f4")
    body = b"".join(struct.pack("<3f", 0, 0, 0) + c.tobytes() + b"\0\0" for c in corners)
    return header.ljust(80, b" ") + struct.pack("<I", len(F) if count is None else count) + body


def stl_ascii(end: str = "endsolid bone\n") -> bytes:
    facets = "".join(
        "facet normal 0 0 0\n outer loop\n" + rows(V[face], "  vertex ") + " endloop\nendfacet\n" for face in F
    )
    return ("solid bone\n" + facets + end).encode()


def ply(
    order: str = "<", n_v: object = 4, n_f: object = 4, faces: bytes | None = None, end: str = "end_header\n"
) -> bytes:
    names = {"<": "binary_little_endian", ">": "binary_big_endian"}
    head = (
        f"ply\nformat {names[order]} 1.0\ncomment SPACE=LPS\nelement vertex {n_v}\nproperty double x\n"
        f"property double y\nproperty double z\nelement face {n_f}\nproperty list uchar int vertex_indices\n{end}"
    )
    if faces is None:
        faces = b"".join(struct.pack(order + "B3i", 3, *face) for face in F)
    return head.encode() + V.astype(order + "f8").tobytes() + faces


def ply_ascii(n_v: object = 4, n_f: object = 4, points: str | None = None, faces: str | None = None) -> bytes:
    head = (
        f"ply\nformat ascii 1.0\nelement vertex {n_v}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {n_f}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    return (head + (rows(V) if points is None else points) + (rows(F, "3 ") if faces is None else faces)).encode()


def vtk(
    binary: bool = False,
    version: str = "3.0",
    sections: bytes | None = None,
    dataset: str = "POLYDATA",
    n_v: object = 4,
) -> bytes:
    head = f"# vtk DataFile Version {version}\nbone\n{'BINARY' if binary else 'ASCII'}\nDATASET {dataset}\n".encode()
    points = V.astype(">f8").tobytes() + b"\n" if binary else rows(V).encode()
    if sections is None:
        cells = np.c_[np.full(4, 3), F]
        data = cells.astype(">i4").tobytes() + b"\n" if binary else rows(cells).encode()
        sections = b"POLYGONS 4 16\n" + data
    return head + f"POINTS {n_v} double\n".encode() + points + sections


def vtk5(binary: bool) -> bytes:
    offsets, flat = np.arange(0, 13, 3), F.reshape(-1)
    pack = (lambda a: a.astype(">i8").tobytes()) if binary else (lambda a: " ".join(map(str, a)).encode())
    metadata = b"METADATA\nINFORMATION 1\nNAME L2_NORM_RANGE LOCATION vtkDataArray\nDATA 2 0 1\n\n"
    body = (
        metadata
        + b"POLYGONS 5 12\nOFFSETS vtktypeint64\n"
        + pack(offsets)
        + b"\nCONNECTIVITY vtktypeint64\n"
        + pack(flat)
    )
    return vtk(binary, "5.1", body + b"\nPOINT_DATA 4\nSCALARS a float\n")


def obj(faces: str | None = None, points: str | None = None) -> bytes:
    return ("# bone\nmtllib no.mtl\n" + (points or rows(V, "v ")) + (faces or rows(F + 1, "f "))).encode()


def off(head: str = "OFF\n4 4 0\n", points: str | None = None, faces: str | None = None) -> bytes:
    return (head + (points or rows(V)) + (faces or rows(F, "3 "))).encode()


QUAD = np.array([[0, 1, 2], [0, 2, 3]])
VALID: dict[str, tuple[str, bytes, np.ndarray, np.ndarray]] = {
    "stl binary": ("a.stl", stl_binary(), V32, F),
    "stl binary that begins with solid": ("a.stl", stl_binary(b"solid facet 3D Slicer"), V32, F),
    "stl in capitals": ("A.STL", stl_binary(), V32, F),
    "stl ascii": ("a.stl", stl_ascii(), V, F),
    "stl ascii, crlf": ("a.stl", stl_ascii().replace(b"\n", b"\r\n"), V, F),
    "stl ascii, upper case, two solids": ("a.stl", stl_ascii().upper() + b"solid b\nendsolid b\n", V, F),
    "non-ascii file name": ("fémur 左.stl", stl_binary(), V32, F),
    "ply little endian": ("a.ply", ply(), V, F),
    "ply big endian": ("a.ply", ply(">"), V, F),
    "ply crlf header": ("a.ply", ply(end="end_header\r\n"), V, F),
    "ply ascii": ("a.ply", ply_ascii(), V, F),
    "ply quad": ("a.ply", ply(n_f=1, faces=struct.pack("<B4i", 4, 0, 1, 2, 3)), V, QUAD),
    "ply quad and triangle": (
        "a.ply", ply(n_f=2, faces=struct.pack("<B3iB4i", 3, 0, 2, 1, 4, 0, 1, 2, 3)), V, np.r_[F[:1], QUAD],
    ),
    "ply ascii quad and triangle": ("a.ply", ply_ascii(n_f=2, faces="3 0 2 1\n4 0 1 2 3\n"), V, np.r_[F[:1], QUAD]),
    "ply extra columns and elements": (
        "a.ply",
        b"ply\nformat ascii 1.0\nelement vertex 4\nproperty uchar red\nproperty float y\nproperty float x\n"
        b"property float z\n"
        b"element edge 1\nproperty int a\nelement face 4\nproperty float quality\n"
        b"property list uchar uint vertex_index\n"
        b"property list uchar float texcoord\nend_header\n"
        + rows(np.c_[np.zeros(4), V[:, [1, 0, 2]]]).encode() + b"7\n"
        + b"".join(b"0.5 3 %d %d %d 2 0 1\n" % tuple(f) for f in F), V, F,
    ),
    "obj": ("a.obj", obj(), V, F),
    "obj negative indices, slashes, quad": ("a.obj", obj("f -4//1 -3//2 -2//3 -1//4\n"), V, QUAD),
    "obj negative indices between vertices": ("a.obj",
        b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 0 0 1\nf -4 -1 -3\n",
        np.eye(4)[:, 1:], np.array([[0, 1, 2], [0, 3, 1]]),
    ),
    "obj with groups": ("a.obj", obj("g a\nusemtl b\ns off\nvn 0 0 1\nvt 0 0\n" + rows(F + 1, "f ")), V, F),
    "off": ("a.off", off(), V, F),
    "off counts in the first line, comments, colours, quad": (
        "a.off", off("OFF 4 1 0 # bone\n# c\n\n", faces="4 0 1 2 3 0.1 0.2 0.3\n"), V, QUAD,
    ),
    "vtk ascii": ("a.vtk", vtk(), V, F),
    "vtk binary": ("a.vtk", vtk(binary=True), V, F),
    "vtk 5 ascii": ("a.vtk", vtk5(binary=False), V, F),
    "vtk 5 binary": ("a.vtk", vtk5(binary=True), V, F),
    "vtk lines, then a quad": ("a.vtk", vtk(sections=b"LINES 1 3\n2 0 1\nPOLYGONS 1 5\n4 0 1 2 3\n"), V, QUAD),
    "vtk triangle strip": (
        "a.vtk", vtk(sections=b"TRIANGLE_STRIPS 1 5\n4 0 1 2 3\n"), V, np.array([[0, 1, 2], [1, 3, 2]]),
    ),
    "vtk field before the points": (
        "a.vtk", vtk().replace(b"POINTS", b"FIELD FieldData 1\nSPACE 1 3 float\n1 2 3\nPOINTS"), V, F,
    ),
}  # fmt: skip

HTML = b"<!DOCTYPE html><html><body>Sign in</body></html>" * 9
HOSTILE: dict[str, tuple[str, bytes, str]] = {
    "empty stl": ("a.stl", b"", "empty"),
    "empty ply": ("a.ply", b"", "empty"),
    "garbage stl": ("a.stl", bytes(range(256)) * 4, "not a readable STL"),
    "garbage ply": ("a.ply", bytes(range(256)) * 4, "begin with 'ply'"),
    "garbage obj": ("a.obj", bytes(range(256)) * 4, "not a readable OBJ"),
    "garbage off": ("a.off", bytes(range(256)) * 4, "not a readable OFF"),
    "garbage vtk": ("a.vtk", bytes(range(256)) * 4, "not a readable VTK"),
    "web page stl": ("a.stl", HTML, "web page"),
    "web page ply": ("a.ply", HTML, "web page"),
    "lfs pointer": ("a.ply", b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git lfs pull"),
    "short stl": ("a.stl", b"\0" * 50, "50 bytes"),
    "stl solid and garbage": ("a.stl", b"solid " + bytes(range(256)) * 4, "not a readable STL"),
    "stl count of 4e9": ("a.stl", b"\0" * 80 + struct.pack("<I", 4_000_000_000), "4000000000 triangles"),
    "stl count of 2^32 - 1": ("a.stl", stl_binary(count=2**32 - 1), "4294967295 triangles"),
    "stl count of 1e7": ("a.stl", b"\0" * 80 + struct.pack("<I", 10_000_000) + b"\0" * 50, "10000000 triangles"),
    "stl without triangles": ("a.stl", b"\0" * 84, "no faces"),
    "stl truncated": ("a.stl", stl_binary()[:-20], "it has 264"),
    "stl with trailing bytes": ("a.stl", stl_binary() + b"x" * 400, "it has 684"),
    "stl with NaN": ("a.stl", stl_binary(vertices=np.where(V == 0, V, np.nan)), "3 of 4 vertices|not finite"),
    "stl with infinity": ("a.stl", stl_binary(vertices=np.where(np.arange(4)[:, None] == 3, np.inf, V)), "1 of 4 vert"),
    "stl ascii truncated in a facet": ("a.stl", stl_ascii()[:-60], "incomplete ASCII STL"),
    "stl ascii truncated between facets": ("a.stl", stl_ascii(end=""), "no 'endsolid'"),
    "stl ascii with words": ("a.stl", stl_ascii().replace(b"vertex 0.0 0.0", b"vertex x 0.0"), "not a number"),
    "stl ascii without facets": ("a.stl", b"solid a\nendsolid a\n", "no faces"),
    "ply of 1e12 vertices": ("a.ply", ply(n_v=10**12), "1000000000000 x 'vertex'"),
    "ply ascii of 1e12 vertices": ("a.ply", ply_ascii(n_v=10**12), "1000000000000 x 'vertex'"),
    "ply of 2e9 faces": ("a.ply", ply(n_f=2 * 10**9), "2000000000 x 'face'"),
    "ply count of -3": ("a.ply", ply(n_v=-3), "-3 x 'vertex'"),
    "ply count in words": ("a.ply", ply(n_v="many"), "header line 'element vertex many'"),
    "ply without end of header": ("a.ply", ply(end=""), "end_header"),
    "ply of unknown type": ("a.ply", ply().replace(b"double z", b"quad z"), "header line 'property quad z'"),
    "ply face index out of range": ("a.ply", ply(n_f=1, faces=struct.pack("<B3i", 3, 0, 1, 99_999_999)), "99999999"),
    "ply negative index": ("a.ply", ply(n_f=1, faces=struct.pack("<B3i", 3, 0, 1, -1)), "index -1"),
    "ply truncated": ("a.ply", ply()[:-20], "truncated PLY|x 'face'"),
    "ply truncated in the vertices": ("a.ply", ply()[:-110], "x 'face'|truncated PLY|x 'vertex'"),
    "ply ascii truncated": ("a.ply", ply_ascii(faces="3 0 1 2\n3 0"), "truncated PLY|x 'face'"),
    "ply list longer than the file": ("a.ply", ply(n_f=1, faces=struct.pack("<B3i", 255, 0, 1, 2)), "truncated PLY"),
    "ply face of two corners": ("a.ply", ply(n_f=1, faces=struct.pack("<B2i", 2, 0, 1)), "2 corners"),
    "ply of points only": ("a.ply", ply().split(b"element face")[0] + b"end_header\n" + V.tobytes(), "no faces"),
    "ply without faces": ("a.ply", ply(n_f=0, faces=b""), "no faces"),
    "ply with NaN": ("a.ply", ply_ascii(points=rows(V[:3]) + "nan 0 0\n"), "1 of 4 vertices"),
    "ply without z": ("a.ply", ply().replace(b"double z", b"double q"), "no vertices with x, y, z"),
    "ply ascii with words": ("a.ply", ply_ascii(points=rows(V[:3]) + "a b c\n"), "not a number"),
    "ply face index inf": ("a.ply", ply_ascii(faces=rows(F[:3], "3 ") + "3 0 1 inf\n"), "not whole numbers"),
    "ply property before element": ("a.ply", b"ply\nformat ascii 1.0\nproperty float x\nend_header\n", "header line"),
    "ply same property twice": ("a.ply", ply().replace(b"double z", b"double x"), "not a readable PLY"),
    "obj index of 4e9": ("a.obj", obj("f 1 2 4000000000\n"), "4000000000"),
    "obj index 0": ("a.obj", obj("f 0 1 2\n"), "index 0"),
    "obj negative index too low": ("a.obj", obj("f -5 -1 -2\n"), "-5"),
    "obj index without end": ("a.obj", obj("f 1 2 " + "9" * 60 + "\n"), "not a whole number"),
    "obj with one line of 10 MB": ("a.obj", obj("f" + " 1 2 3" * 1_700_000 + "\n"), "line 7"),
    "obj without faces": ("a.obj", obj("g empty\n"), "no faces"),
    "obj without vertices": ("a.obj", b"f 1 2 3\n", "no vertices"),
    "obj truncated in a line": ("a.obj", obj()[:-4], "line 10"),
    "obj face of two": ("a.obj", obj("f 1 2\n"), "line 7"),
    "obj with NaN": ("a.obj", obj(points="v nan 0 0\n" + rows(V[1:], "v ")), "1 of 4 vertices"),
    "obj with a 1 MB number": ("a.obj", obj(points="v " + "1" * 1_000_000 + " 0 0\n"), "more than 64 characters"),
    "off face index out of range": ("a.off", off(faces=rows(F[:3], "3 ") + "3 0 1 9\n"), "index 9 is out of range"),
    "off truncated": ("a.off", off(faces=rows(F[:3], "3 ")), "truncated OFF"),
    "off of 1e12 vertices": ("a.off", off("OFF\n1000000000000 4 0\n"), "truncated OFF"),
    "off counts of -3": ("a.off", off("OFF\n-3 4 0\n"), "truncated OFF"),
    "off without counts": ("a.off", b"OFF\n", "line of counts"),
    "off with NaN": ("a.off", off(points=rows(V[:3]) + "nan 0 0\n"), "1 of 4 vertices"),
    "off with words": ("a.off", off(points=rows(V[:3]) + "a b c\n"), "not a number"),
    "off face line cut": ("a.off", off(faces=rows(F[:3], "3 ") + "3 0 1\n"), "face line"),
    "vtk unstructured": ("a.vtk", vtk(dataset="UNSTRUCTURED_GRID"), "not POLYDATA"),
    "vtk of 1e12 points": ("a.vtk", vtk(n_v=10**12), "truncated VTK"),
    "vtk of -3 points": ("a.vtk", vtk(n_v=-3), "truncated VTK"),
    "vtk points in words": ("a.vtk", vtk(n_v="many"), "line 'POINTS many double'"),
    "vtk binary truncated": ("a.vtk", vtk(binary=True)[:-9], "truncated VTK"),
    "vtk ascii truncated": ("a.vtk", vtk()[:-8], "truncated VTK"),
    "vtk index out of range": ("a.vtk", vtk(sections=b"POLYGONS 1 4\n3 0 1 99\n"), "index 99"),
    "vtk cell runs over": ("a.vtk", vtk(sections=b"POLYGONS 2 8\n3 0 1 2 7 0 1 3\n"), "runs over"),
    "vtk negative corner count": ("a.vtk", vtk(sections=b"POLYGONS 2 8\n-3 0 1 2 3 0 1 3\n"), "runs over"),
    "vtk points only": ("a.vtk", vtk(sections=b"VERTICES 1 2\n1 0\n"), "no polygons"),
    "vtk without a third line": ("a.vtk", b"# vtk DataFile Version 3.0\n", "third line"),
    "vtk with NaN": ("a.vtk", vtk().replace(b"0.0 0.0 0.0", b"nan 0.0 0.0"), "1 of 4 vertices"),
    "vtk bad offsets": ("a.vtk", vtk5(binary=False).replace(b"0 3 6 9 12", b"0 3 9 6 12"), "offsets"),
    "vtu": ("a.vtu", b"<VTKFile/>", "save it as .vtp"),
    "unknown suffix": ("a.3ds", stl_binary(), "'.3ds'"),
    "no suffix": ("a", stl_binary(), "''"),
}
