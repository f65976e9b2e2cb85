"""All hostile and all odd but valid files in one table, each with its reader; and a guarded child that tries them.

``python -m tests.support.hostile FOLDER`` writes the files into FOLDER, reads each in a forked child of its own that may
take 30 s of processor time and 200 MB beyond an idle reader, and prints one JSON object per file. POSIX only (``fork``, ``RLIMIT_AS``).
"""

# ruff: noqa: E501

from __future__ import annotations

import io
import json
import os
import resource
import signal
import struct
import sys
import warnings
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.support import mesh_files, vtp_files

TIME_LIMIT_S = 30
MEMORY_LIMIT = 200 * 2**20
TEN_MB = 10_000_000


@dataclass(frozen=True)
class Case:
    """A file, who reads it, and the words of its refusal ("" when it must load)."""

    name: str
    file: str
    data: Callable[[], bytes]
    reader: str
    words: str = ""


def _readers() -> dict[str, Callable[[Path], Any]]:
    from ssmpipe.io.arrays import read_npz
    from ssmpipe.io.images import read_image
    from ssmpipe.io.landmarks import read_landmarks
    from ssmpipe.io.meshes import read_mesh
    from ssmpipe.io.outlines import read_outline
    from ssmpipe.io.splines import read_spline
    from ssmpipe.io.tables import read_cohort
    from ssmpipe.runner.document import read_document

    return {
        "mesh": read_mesh, "landmarks": read_landmarks, "outline": read_outline, "image": read_image,
        "spline": read_spline, "arrays": read_npz, "cohort": read_cohort, "config": read_document,
    }  # fmt: skip


def _npz(**arrays: Any) -> bytes:
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()


SURFACE = {
    "degree": np.array(2), "knots_u": np.array([0, 0, 0, 1, 1, 1.0]), "knots_v": np.array([0, 0, 0, 1, 1, 1.0]),
    "control_points": np.arange(27.0).reshape(3, 3, 3),
}  # fmt: skip


def _npz_zeros() -> bytes:
    """400 MB of zeros in 0.4 MB."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("control_points.npy", "w") as member:
        np.lib.format.write_array_header_1_0(member, {"descr": "<f8", "fortran_order": False, "shape": (50_000_000,)})
        for _ in range(400):
            member.write(bytes(1_000_000))
    return out.getvalue()


def _npz_member(header: bytes, body: bytes = b"", name: str = "degree.npy") -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr(name, b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + body)
    return out.getvalue()


def _npz_lie() -> bytes:
    return _npz_member(b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }\n", bytes(8))


def _npz_pickle() -> bytes:
    out = io.BytesIO()
    np.savez(out, degree=np.array([{"__reduce__": 1}], dtype=object))
    return out.getvalue()


def _npz_twice() -> bytes:
    out = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(out, "w") as archive:
        warnings.simplefilter("ignore")
        for value in (b"1", b"2"):
            archive.writestr("degree.npy", value)
    return out.getvalue()


def _png(width: int, height: int, rows: bytes) -> bytes:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows, 9)) + chunk(b"IEND", b"")


def _picture(kind: str) -> bytes:
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(np.arange(240, dtype=np.uint8).reshape(12, 20)).save(out, format=kind)
    return out.getvalue()


def _repeated(head: str, unit: str, tail: str = "", size: int = TEN_MB) -> Callable[[], bytes]:
    return lambda: (head + unit * (size // len(unit)) + tail).encode()


def _mixed_ply() -> bytes:
    """Triangles and quadrilaterals in turn, 740,000 rows in 3.3 MB: valid, slow for whoever walks row by row."""
    n = TEN_MB // 27
    head = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {2 * n}\nproperty list uchar uchar vertex_indices\nend_header\n"
    )
    return head.encode() + mesh_files.V.astype("<f4").tobytes() + b"\x03\x00\x01\x02\x04\x00\x01\x02\x03" * n


FCSV = "# Markups fiducial file version = 4.10\n# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc\n"
BOMB = "<!DOCTYPE a [<!ENTITY a 'aaaaaaaaaa'>" + "".join(
    f"<!ENTITY {chr(c)} '{f'&{chr(c - 1)};' * 10}'>" for c in range(98, 107)
)
YAML_BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 10)
)
GARBAGE = bytes(range(256)) * 4
HTML = mesh_files.HTML
LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n"


def _text_cases() -> list[tuple[str, str, Callable[[], bytes] | bytes | str, str, str]]:
    """Landmarks, outlines, images, arrays, tables, configs; large surfaces."""
    return [
        # surfaces that are large, or slow for a careless reader
        ("ply triangles and quads in turn", "a.ply", _mixed_ply, "mesh", ""),
        ("ply ascii, 10 MB behind the faces", "a.ply",
         lambda: mesh_files.ply_ascii() + b"1 " * (TEN_MB // 2), "mesh", ""),
        ("ply ascii face of 5 million corners", "a.ply",
         lambda: mesh_files.ply_ascii(n_f=1, faces="5000000" + " 1" * 5_000_000), "mesh", "corners|truncated PLY"),
        ("ply of 60000 properties", "a.ply",
         lambda: mesh_files.ply().replace(b"property double x\n", b"".join(b"property char %d\n" % i for i in range(50_000)) + b"property double x\n"),
         "mesh", "PLY"),
        ("ply header of 10 MB", "a.ply", _repeated("ply\nformat ascii 1.0\n", "comment a\n"), "mesh", "end_header"),
        ("stl ascii vertices, 10 MB", "a.stl", _repeated("solid a\nfacet\n", "vertex 0 0 0\n"), "mesh", "incomplete ASCII STL"),
        ("stl ascii spaces, 10 MB", "a.stl", _repeated("solid a\nfacet normal\nvertex", " "), "mesh", "incomplete ASCII STL"),
        ("stl ascii empty lines, 10 MB", "a.stl", _repeated("solid a\nfacet normal\nvertex 0 0 0\nendfacet\n", "\n"), "mesh", "incomplete ASCII STL"),
        ("stl ascii vertex of 10 MB", "a.stl", _repeated("solid a\nfacet normal\nendfacet\n" + "vertex 0 0 0\n" * 2 + "vertex ", "a"), "mesh", "incomplete ASCII STL"),
        ("vtk metadata, 10 MB", "a.vtk", lambda: mesh_files.vtk(sections=b"METADATA\n\n" * 1_000_000), "mesh", "more than 1000 sections"),
        ("vtk empty sections, 10 MB", "a.vtk", lambda: mesh_files.vtk(sections=b"LINES 0 0\n" * 1_000_000), "mesh", "more than 1000 sections"),
        ("vtk small fields, 10 MB", "a.vtk", lambda: mesh_files.vtk(sections=b"FIELD a 1\nb 1 1 int\n1\n" * 400_000), "mesh", "more than 1000 sections"),
        ("off one line of 10 MB", "a.off", _repeated("OFF\n4 1 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n", "3 0 1 2 "), "mesh", "OFF"),
        ("off lines, 10 MB", "a.off", _repeated("OFF\n4 4 0\n", "1\n"), "mesh", "OFF"),
        ("obj empty lines, 10 MB", "a.obj", _repeated("", "\n"), "mesh", "no vertices"),
        ("obj vertices, 10 MB", "a.obj", _repeated("", "v 0 0 0\n"), "mesh", "no faces"),
        ("vtk polygons line of 10 MB", "a.vtk",
         lambda: mesh_files.vtk(sections=b"POLYGONS 1 5000000\n4999999" + b" 1" * 4_999_999), "mesh", "corners"),
        ("vtk polygons of no corners", "a.vtk",
         lambda: mesh_files.vtk(sections=b"POLYGONS 5000000 5000000\n" + b"0 " * 5_000_000), "mesh", "corners"),
        ("vtk field of 1e12 numbers", "a.vtk",
         lambda: mesh_files.vtk(sections=b"FIELD a 1\nb 1000000 1000000 double\n"), "mesh", "truncated VTK"),
        ("vtk field count of 1e12", "a.vtk", lambda: mesh_files.vtk(sections=b"FIELD a 1000000000000\n"), "mesh", "VTK"),
        ("vtp text of 10 MB", "a.vtp", _repeated("<VTKFile type='PolyData'><Piece>", "a"), "mesh", "VTP"),
        ("vtp attribute of 10 MB", "a.vtp", _repeated("<VTKFile type='", "a", "'/>"), "mesh", "not PolyData"),
        # landmarks
        ("json empty", "a.json", b"", "landmarks", "is empty|not readable JSON"),
        ("json garbage", "a.json", GARBAGE, "landmarks", "not UTF-8|not readable JSON"),
        ("json web page", "a.json", HTML, "landmarks", "web page|not readable JSON"),
        ("json lfs pointer", "a.json", LFS, "landmarks", "git lfs pull|not readable JSON"),
        ("json truncated", "a.json", '{"a": {"b": [1, 2', "landmarks", "not readable JSON"),
        ("json deep", "a.json", _repeated("", "["), "landmarks", "not readable JSON|lists"),
        ("json deep objects", "a.json", _repeated("", '{"a":', size=1_000_000), "landmarks", "not readable JSON|lists"),
        ("json empty lists, 10 MB", "a.json", _repeated("[", "[],", "[]]"), "landmarks", "lists"),
        ("json empty objects, 10 MB", "a.json", _repeated("[", "{},", "{}]"), "landmarks", "lists"),
        ("json number of 5000 digits", "a.json", '{"a": {"b": [' + "1" * 5000 + ", 2, 3]}}", "landmarks", "not readable JSON|digits|not finite"),
        ("json number of 1 MB", "a.json", '{"a": {"b": [' + "1" * 1_000_000 + ", 2, 3]}}", "landmarks", "not readable JSON|digits|not finite"),
        ("json 1e999", "a.json", '{"a": {"b": [1e999, 2, 3]}}', "landmarks", "not finite"),
        ("json number of 400 digits", "a.json", '{"a": {"b": [' + "1" * 400 + ", 2, 3]}}", "landmarks", "not a point|not finite"),
        ("json NaN", "a.json", '{"a": {"b": [NaN, 2, 3]}}', "landmarks", "not finite"),
        ("json name twice", "a.json", '{"a": {"b": [1, 2, 3], "b": [1, 2, 4]}}', "landmarks", "occurs twice"),
        ("json lone surrogate", "a.json", '{"a": {"\\ud800": [1, 2]}}', "landmarks", "cannot be the name"),
        ("json numbers as names", "a.json", '[{"id": 1, "coordinates": [1, 2, 3]}]', "landmarks", "no name"),
        ("json null", "a.json", "null", "landmarks", "not a landmark table"),
        ("json with byte order mark", "a.json", b'\xef\xbb\xbf{"a": {"b": [1, 2, 3]}}', "landmarks", ""),
        ("json no shapes", "a.json", "{}", "landmarks", ""),
        ("mrk without points", "a.mrk.json", '{"markups": []}', "landmarks", ""),
        ("mrk markup of text", "a.mrk.json", '{"markups": ["x"]}', "landmarks", "not a Slicer markups"),
        ("mrk position of text", "a.mrk.json", '{"markups": [{"controlPoints": [{"label": "a", "position": "123"}]}]}', "landmarks", "not a point"),
        ("mrk frame of a list", "a.mrk.json", '{"markups": [{"coordinateSystem": [[]], "controlPoints": []}]}', "landmarks", "coordinate system"),
        ("mrk point without a position", "a.mrk.json", '{"markups": [{"controlPoints": [{"label": "a"}]}]}', "landmarks", "not a point"),
        ("fcsv empty", "a.fcsv", b"", "landmarks", "is empty"),
        ("fcsv only a head", "a.fcsv", FCSV, "landmarks", ""),
        ("fcsv garbage", "a.fcsv", GARBAGE, "landmarks", "not UTF-8"),
        ("fcsv open quote, 10 MB", "a.fcsv", _repeated(FCSV + '1,"', "a"), "landmarks", "line 3|field"),
        ("fcsv lines, 10 MB", "a.fcsv", _repeated(FCSV, "1\n"), "landmarks", "line 3"),
        ("fcsv NUL", "a.fcsv", FCSV + "1,\0,2\n", "landmarks", "line 3"),
        ("fcsv words", "a.fcsv", FCSV + "1,x,2,3,0,0,0,1,1,1,0,LEC,\n", "landmarks", "not a point"),
        ("pp empty", "a.pp", b"", "landmarks", "is empty|not readable XML"),
        ("pp entities that multiply", "a.pp", BOMB + "]><a>&j;</a>", "landmarks", "document type|entities"),
        ("pp external entity", "a.pp", '<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]><a>&b;</a>', "landmarks", "document type|entities"),
        ("pp deep, 10 MB", "a.pp", _repeated("", "<a>"), "landmarks", "elements"),
        ("pp points, 10 MB", "a.pp", _repeated("<a>", "<point/>", "</a>"), "landmarks", "elements"),
        ("pp attributes, 10 MB", "a.pp", lambda: ("<a " + "".join(f"b{i}='' " for i in range(900_000)) + "/>").encode(), "landmarks", "an element of"),
        ("pp other xml", "a.pp", "<svg/>", "landmarks", ""),
        ("csv landmarks, lines of 10 MB", "a.csv", _repeated("id,landmark,x,y\n", "1\n"), "landmarks", "line 2: 1 cells"),
        ("csv landmarks without ids", "a.csv", _repeated("id,landmark,x,y\n", ",,,\n", size=1_000_000) , "landmarks", ""),
        ("csv landmarks, crlf and semicolons", "a.csv", "id;landmark;x;y;z\r\na;b;1;2;3\r\n", "landmarks", ""),
        ("asf without its picture", "a.asf", "3\n0 4 0.5 0.5 0 0 0\n0 4 0.6 0.5 0 0 0\n0 4 0.5 0.7 0 0 0\n\nno.jpg\n", "outline", ""),
        ("asf promises 1e9", "a.asf", "1000000000\n0 4 0.5 0.5 0 0 0\n", "landmarks", "promised"),
        ("asf number of 5000 digits", "a.asf", "9" * 5000 + "\n", "landmarks", "promised|number of points"),
        ("asf lines, 10 MB", "a.asf", _repeated("3\n", "1\n"), "landmarks", "promised"),
        ("asf digits of another script", "a.asf", "\u00b2\n", "landmarks", "number of points"),
        ("asf type not finite", "a.asf", "3\n" + "0 nan 0.5 0.5 0 0 0\n" * 3, "outline", "not finite"),
        ("pts promises 1e9", "a.pts", "version: 1\nn_points: 1000000000\n{\n1 2\n}\n", "landmarks", "promises 1000000000"),
        ("pts lines, 10 MB", "a.pts", _repeated("", "1\n"), "landmarks", "line 1"),
        ("pts one line of 10 MB", "a.pts", _repeated("", "1 "), "landmarks", "numbers, need 2"),
        ("pts empty", "a.pts", b"", "landmarks", "is empty|no points|has 0"),
        ("landmarks in a workbook", "a.xlsx", b"PK\3\4", "landmarks", "unknown kind"),
        # outlines
        ("csv outline empty", "a.csv", b"", "outline", "is empty"),
        ("csv outline garbage", "a.csv", GARBAGE, "outline", "not UTF-8"),
        ("csv outline in UTF-16", "a.csv", "x,y\n1,2\n".encode("utf-16"), "outline", "not UTF-8"),
        ("csv outline NUL", "a.csv", "x,y\n1,\0\n", "outline", "line 2"),
        ("csv outline of 10 MB in one line", "a.csv", _repeated("x,y\n", "1,"), "outline", "line 2"),
        ("csv header of 10 MB", "a.csv", _repeated("x", ","), "outline", "columns|field"),
        ("csv header with an open quote", "a.csv", _repeated('x,"', "a"), "outline", "field|line"),
        ("csv outline, open quote", "a.csv", _repeated('x,y\n1,"', "a"), "outline", "field"),
        ("csv outline, 2.5 million points", "a.csv", _repeated("x,y\n", "1,1\n"), "outline", "more than 300000 points"),
        ("csv outline, one point many times", "a.csv", "x,y\n" + "1,1\n" * 9, "outline", ""),
        ("csv outline 1e999", "a.csv", "x,y\n1,1e999\n3,4\n", "outline", "not finite"),
        ("csv outline, tabs and a comment", "a.csv", "# by hand\nx\ty\n0\t0\n1\t0\n1\t1\n", "outline", ""),
        ("pts outline, numbered", "a.pts", "version: 1\nn_points: 3\n{\n0 0\n1 0\n1 1\n}\n", "outline", ""),
        # images
        ("png empty", "a.png", b"", "image", "is empty"),
        ("png garbage", "a.png", GARBAGE, "image", "not a readable PNG"),
        ("png of 100 megapixels in 0.1 MB", "a.png", lambda: _png(10_000, 10_000, bytes(10_001 * 10_000)), "image", "pixels"),
        ("png of 3.6 gigapixels", "a.png", lambda: _png(60_000, 60_000, b""), "image", "pixels"),
        ("png text chunk of 100 MB", "a.png", lambda: _png_text_bomb(), "image", "PNG"),
        ("pgm that lies", "a.pgm", b"P5 9000 9000 255\n\0\0", "image", "which no photograph has"),
        ("pgm of 1e12 pixels", "a.pgm", b"P5 1000000 1000000 255\n\0\0", "image", "pixels|not a readable"),
        ("jpg that is a png", "a.jpg", lambda: _picture("PNG"), "image", "not a readable JPEG"),
        ("gif", "a.gif", b"GIF89a", "image", "not an image format"),
        ("png truncated", "a.png", lambda: _picture("PNG")[:-30], "image", "not a readable PNG"),
        ("png", "a.PNG", lambda: _picture("PNG"), "image", ""),
        ("webp", "a.webp", lambda: _picture("WEBP"), "image", ""),
        ("tif", "a.tif", lambda: _picture("TIFF"), "image", ""),
        # arrays
        ("npz empty", "a.npz", b"", "spline", "not a readable .npz"),
        ("npz garbage", "a.npz", GARBAGE, "spline", "not a readable .npz"),
        ("npz truncated", "a.npz", lambda: _npz(**SURFACE)[:-60], "spline", "not a readable .npz"),
        ("npz of 400 MB zeros in 0.4 MB", "a.npz", _npz_zeros, "arrays", "unpacks to"),
        ("npz that declares 1e12 numbers", "a.npz", _npz_lie, "spline", "declares 8000000000000 bytes"),
        ("npz with a pickle", "a.npz", _npz_pickle, "spline", "Python objects"),
        ("npz header of 60 kB", "a.npz", lambda: _npz_member(b"(" * 60_000), "spline", "not a readable .npz"),
        ("npz header that is code", "a.npz", lambda: _npz_member(b"__import__('os').abort()\n"), "spline", "not a readable .npz"),
        ("npz shape of negative size", "a.npz", lambda: _npz_member(b"{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }\n"), "spline", "declares -8 bytes"),
        ("npz member twice", "a.npz", _npz_twice, "spline", "npz|twice"),
        ("npz without members", "a.npz", lambda: _npz(), "spline", "has no array"),
        ("npz of text", "a.npz", lambda: _npz(**{**SURFACE, "control_points": np.array(["a"])}), "spline", "a.npz"),
        ("npz with NaN", "a.npz", lambda: _npz(**{**SURFACE, "control_points": np.full((3, 3, 3), np.nan)}), "spline", "a.npz"),
        ("npz with complex numbers", "a.npz", lambda: _npz(**{**SURFACE, "control_points": np.ones((3, 3, 3)) * 1j}), "spline", "a.npz"),
        ("npz degree of 1e9", "a.npz", lambda: _npz(**{**SURFACE, "degree": np.array(10**9)}), "spline", "a.npz"),
        ("npz knots that fall", "a.npz", lambda: _npz(**{**SURFACE, "knots_u": np.array([0, 0, 0, 1, 1, 0.5])}), "spline", "a.npz"),
        ("npz beside arrays of text", "a.npz", lambda: _npz(**SURFACE, made_by=np.array("hand")), "spline", ""),
        ("npz spline", "a.npz", lambda: _npz(**SURFACE), "spline", ""),
        # tables and configs
        ("cohort empty", "a.csv", b"", "cohort", "is empty"),
        ("cohort lines of 10 MB", "a.csv", _repeated("id\n", "a\n"), "cohort", "occurs already in line 2"),
        ("cohort ids twice", "a.csv", "id,side\na,L\na,R\n", "cohort", "occurs already in line 2"),
        ("cohort ragged", "a.csv", "id,side\na\n", "cohort", "line 2: 1 cells"),
        ("cohort in a workbook", "a.csv", b"PK\3\4\x14\0\xff", "cohort", "not UTF-8|no column"),
        ("cohort from a spreadsheet", "a.csv", b"\xef\xbb\xbfsep=;\r\nid;side\r\na;L\r\n", "cohort", ""),
        ("yaml bomb", "a.yaml", YAML_BOMB, "config", "anchors and aliases"),
        ("yaml merge key", "a.yaml", "a: &a {b: 1}\nc: {<<: *a}\n", "config", "anchors and aliases"),
        ("yaml alias of itself", "a.yaml", "a: &a [*a]\n", "config", "anchors and aliases"),
        ("yaml object", "a.yaml", "a: !!python/object/apply:os.abort []\n", "config", "tags"),
        ("yaml deep", "a.yaml", "a: " + "[" * 100_000, "config", "nested deeper"),
        ("yaml deep blocks", "a.yaml", "".join(" " * i + "a:\n" for i in range(500)), "config", "nested deeper"),
        ("yaml of 10 MB", "a.yaml", _repeated("a: ", "x"), "config", "larger than"),
        ("yaml key twice", "a.yaml", "a: 1\na: 2\n", "config", "a.yaml:2"),
        ("yaml number of 5000 digits", "a.yaml", "seed: " + "9" * 5000 + "\n", "config", "not valid YAML"),
        ("yaml key that is a list", "a.yaml", ": ? -  - -\n", "config", "not valid YAML"),
        ("yaml list", "a.yaml", "- a\n", "config", "must be a mapping"),
        ("yaml garbage", "a.yaml", GARBAGE, "config", "not UTF-8|cannot read"),
        ("yaml NUL", "a.yaml", b"a: \0\n", "config", "a.yaml"),
        ("yaml", "a.yaml", "name: a\ninput: {scans: b}\n", "config", ""),
    ]  # fmt: skip


def _png_text_bomb() -> bytes:
    body = b"Comment\0\0" + zlib.compress(bytes(100_000_000), 9)
    chunk = struct.pack(">I", len(body)) + b"zTXt" + body + struct.pack(">I", zlib.crc32(b"zTXt" + body))
    whole = _picture("PNG")
    return whole[:33] + chunk + whole[33:]


def cases() -> list[Case]:
    """Return the whole table."""
    found = [Case(f"valid, {n}", f, lambda d=d: d, "mesh") for n, (f, d, _, _) in mesh_files.VALID.items()]
    found += [Case(f"valid vtp, {n}", "a.vtp", lambda d=d: d, "mesh") for n, d in vtp_files.VALID.items()]
    found += [Case(f"hostile, {n}", f, lambda d=d: d, "mesh", w) for n, (f, d, w) in mesh_files.HOSTILE.items()]
    found += [Case(f"hostile vtp, {n}", "a.vtp", lambda d=d: d, "mesh", w) for n, (d, w) in vtp_files.HOSTILE.items()]
    for name, file, data, reader, words in _text_cases():
        made = data if callable(data) else (lambda d=data: d if isinstance(d, bytes) else d.encode())
        found.append(Case(name, file, made, reader, words))
    return found


def _resident() -> int:
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize()


def _address_space() -> int:
    with open("/proc/self/statm") as file:
        return int(file.read().split()[0]) * resource.getpagesize()


def _in_child(read: Callable[[Path], Any], path: Path, pipe: int) -> None:
    """Read one file under the limits and send the verdict; never returns."""
    from ssmpipe.core.errors import SsmpipeError

    limit = _address_space() + MEMORY_LIMIT
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CPU, (TIME_LIMIT_S, TIME_LIMIT_S + 1))
    signal.alarm(20 * TIME_LIMIT_S)  # for one that sleeps; a busy machine is no reason to fail
    try:
        read(path)
        text = "loaded"
    except SsmpipeError as error:
        text = f"refused: {error}"
    except MemoryError:
        text = "needs more than 200 MB"
    except BaseException as error:
        text = f"{type(error).__name__}: {error}"[:300]
    os.write(pipe, text.encode("utf-8", "backslashreplace")[:4000])
    os._exit(0)


def try_file(read: Callable[[Path], Any], path: Path) -> dict[str, Any]:
    """Read a file in a forked child; return verdict, processor seconds and peak memory in MB beyond what an idle reader holds."""
    idle = _resident()
    receive, send = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12 warns of fork beside threads; there are none
        pid = os.fork()
    if pid == 0:
        _in_child(read, path, send)
    os.close(send)
    with os.fdopen(receive, "rb") as pipe:
        text = pipe.read().decode("utf-8")
    _, status, usage = os.wait4(pid, 0)
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        text = (
            f"took more than {TIME_LIMIT_S} s"
            if number in (signal.SIGALRM, signal.SIGXCPU)
            else f"killed by signal {number}"
        )
    peak = max(usage.ru_maxrss * 1024 - idle, 0) / 2**20
    return {"verdict": text, "seconds": round(usage.ru_utime + usage.ru_stime, 4), "mb": round(peak, 1)}


def main(folder: Path) -> None:
    """Try the whole table; one line of JSON per file."""
    readers = _readers()
    for number, case in enumerate(cases()):
        place = folder / f"{number:03d}"
        place.mkdir()
        (place / case.file).write_bytes(case.data())
        found = try_file(readers[case.reader], place / case.file)
        print(json.dumps({"name": case.name, "reader": case.reader, "words": case.words, **found}), flush=True)
        (place / case.file).unlink()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
