"""VTK XML surfaces: every way of packing, and hostile files with the words that refuse them."""

from __future__ import annotations

import base64
import struct
import zlib

import numpy as np

V = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]) * 10 / 3
F = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
BLOCK = 40


def pack(values: np.ndarray, *, compress: bool, header: str, order: str, text: bool) -> bytes:
    """One array as VTK writes it: header and content; in base64 the header of a compressed array stands by itself."""
    content = values.astype(values.dtype.newbyteorder(order)).tobytes()
    number = order + {"UInt32": "I", "UInt64": "Q"}[header]
    if not compress:
        whole = struct.pack(number, len(content)) + content
        return base64.b64encode(whole) if text else whole
    blocks = [zlib.compress(content[i : i + BLOCK]) for i in range(0, len(content), BLOCK)]
    head = [len(blocks), BLOCK, len(content) % BLOCK, *map(len, blocks)]
    packed = b"".join(struct.pack(number, n) for n in head)
    if text:
        return base64.b64encode(packed) + base64.b64encode(b"".join(blocks))
    return packed + b"".join(blocks)


def vtp(
    form: str = "binary",
    *,
    raw: bool = False,
    compress: bool = False,
    header: str = "UInt32",
    order: str = "<",
    faces: np.ndarray = F,
    section: str = "Polys",
    n_points: object = 4,
    n_pieces: int = 1,
    kind: str = "PolyData",
    offsets: np.ndarray | None = None,
) -> bytes:
    """The tetrahedron as a VTK XML file."""
    ends = np.arange(1, len(faces) + 1) * faces.shape[1] if offsets is None else offsets
    tail = b""

    def array(name: str, values: np.ndarray, extra: str = "") -> str:
        nonlocal tail
        type_name = {"f": "Float64", "i": "Int64"}[values.dtype.kind]
        head = f'<DataArray type="{type_name}" Name="{name}"{extra} format="{form}"'
        if form == "ascii":
            return f"{head}>\n  {' '.join(map(repr, values.ravel().tolist()))}\n</DataArray>\n"
        text = not (form == "appended" and raw)
        packed = pack(values.ravel(), compress=compress, header=header, order=order, text=text)
        if form == "binary":
            return f"{head}>\n  {packed.decode()}\n</DataArray>\n"
        place = len(tail)
        tail += packed
        return f'{head} offset="{place}"/>\n'

    count = f'NumberOf{section}="{len(faces)}"'
    piece = (
        f'<Piece NumberOfPoints="{n_points}" NumberOfVerts="0" {count}>\n<PointData>{array("q", V[:, 0])}</PointData>\n'
        f"<Points>{array('Points', V, extra=' NumberOfComponents=' + chr(34) + '3' + chr(34))}</Points>\n"
        f"<Verts>{array('connectivity', F[:0])}</Verts>\n"
        f"<{section}>{array('connectivity', faces)}{array('offsets', ends)}</{section}>\n</Piece>\n"
    )
    compressor = ' compressor="vtkZLibDataCompressor"' if compress else ""
    byte_order = {"<": "LittleEndian", ">": "BigEndian"}[order]
    appended = b""
    if form == "appended":
        encoding = b"raw" if raw else b"base64"
        appended = b'<AppendedData encoding="' + encoding + b'">\n _' + tail + b"\n</AppendedData>\n"
    head = (
        f'<?xml version="1.0"?>\n<VTKFile type="{kind}" version="1.0" byte_order="{byte_order}" header_type="{header}"{compressor}>\n'
        f"<{kind}>\n{piece * n_pieces}</{kind}>\n"
    )
    return head.encode() + appended + b"</VTKFile>\n"


VALID = {
    "text": vtp("ascii"),
    "base64": vtp(),
    "base64, 64 bit header, big endian": vtp(header="UInt64", order=">"),
    "base64, compressed": vtp(compress=True),
    "base64, compressed, 64 bit header": vtp(compress=True, header="UInt64"),
    "appended base64": vtp("appended"),
    "appended base64, compressed": vtp("appended", compress=True),
    "appended raw": vtp("appended", raw=True),
    "appended raw, compressed, big endian": vtp("appended", raw=True, compress=True, order=">"),
}


BOMB = (
    b'<!DOCTYPE a [<!ENTITY a "aaaaaaaaaa">'
    + b"".join(b'<!ENTITY %c "%s">' % (c, b"&%c;" % (c - 1) * 10) for c in range(98, 107))
    + b"]>"
)
ZEROS = zlib.compress(bytes(96_000_000), 9)
ZIP_BOMB = struct.pack("<4I", 1, 96_000_000, 0, len(ZEROS)) + ZEROS
HOSTILE = {
    "garbage": (bytes(range(256)) * 4, "not a readable VTP"),
    "text": (b"solid bone", "not a readable VTP"),
    "other xml": (b"<svg/>", "first element is not VTKFile"),
    "no pieces": (b'<VTKFile type="PolyData"/>', "no pieces"),
    "volume mesh": (vtp(kind="UnstructuredGrid"), "'UnstructuredGrid' is not PolyData"),
    "entities that multiply": (VALID["base64"].replace(b"<VTKFile", BOMB + b"<VTKFile", 1), "document type"),
    "a million elements": (b"<VTKFile>" + b"<a/>" * 1_000_000 + b"</VTKFile>", "too many"),
    "deep nesting": (b"<VTKFile>" + b"<a>" * 100_000, "deeply nested"),
    "truncated": (VALID["base64"][:-60], "not a readable VTP"),
    "truncated appended": (VALID["appended raw"][:-120], "truncated VTP: Polys offsets needs 4 numbers"),
    "1e12 points": (vtp(n_points=10**12), "its header says 96 bytes, 24000000000000 are needed"),
    "1e12 points as text": (vtp("ascii", n_points=10**12), "truncated VTP: Points Points needs 3000000000000"),
    "1e12 points, compressed": (vtp(compress=True, n_points=10**12), "its blocks hold 96 bytes"),
    "-3 points": (vtp(n_points=-3), "NumberOfPoints is '-3'"),
    "points in words": (vtp(n_points="many"), "NumberOfPoints is 'many'"),
    "no points": (vtp(n_points=0), "no polygons"),
    "index out of range": (vtp("ascii", faces=np.array([[0, 1, 99]])), "index 99 is out of range"),
    "negative index": (vtp(faces=np.array([[0, 1, -1]])), "index -1"),
    "offsets that fall": (vtp(offsets=np.array([3, 9, 6, 12])), "offsets of Polys do not increase"),
    "offsets too large": (vtp(offsets=np.array([3, 6, 9, 10**15])), "Polys connectivity needs 1000000000000000"),
    "two corners": (vtp(faces=np.array([[0, 1]])), "2 corners"),
    "not a number": (vtp("ascii").replace(b"0.0 0.0 0.0 3", b"0.0 x.0 0.0 3"), "not a number"),
    "nan": (vtp("ascii").replace(b"0.0 0.0 0.0 3", b"nan 0.0 0.0 3"), "of 4 vertices"),
    "unknown type": (vtp().replace(b"Float64", b"Float16"), "unknown type 'Float16'"),
    "unknown format": (vtp().replace(b'"binary"', b'"morse"'), "unknown format 'morse'"),
    "unknown packing": (
        vtp(compress=True).replace(b"vtkZLibDataCompressor", b"vtkLZ4DataCompressor"), "packed with vtkLZ4",
    ),
    "offset behind the end": (vtp("appended", raw=True).replace(b'offset="36"', b'offset="9999"'), "truncated VTP: Points Points"),
    "zip bomb": (
        vtp("appended", raw=True, compress=True, n_points=4_000_000).replace(
            b"<AppendedData", b"<!-- -->\n<AppendedData"
        ).split(b" _")[0] + b" _" + pack(V[:, 0], compress=True, header="UInt32", order="<", text=False) + ZIP_BOMB,
        "its blocks do not fit the file",
    ),
}  # fmt: skip
