"""Landmarks of JSON, CSV, Slicer, MeshLab and Scalismo, all in the frame of the scans."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ssmpipe.core.errors import ArtifactError
from ssmpipe.io.landmarks import read_landmarks

FCSV = (
    "# Markups fiducial file version = 4.10\n{frame}"
    "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
    "vtkMRMLMarkupsFiducialNode_0,1.5,2,3,0,0,0,1,1,1,0,LEC,,\n1,-4,5,6,0,0,0,1,1,1,0,\"MEC, low\",,,2,0\n"
)  # fmt: skip


def mrk(system: dict[str, str], **control: object) -> str:
    points = [{"label": "LEC", "position": [1.5, 2, 3]}, {"label": "MEC, low", "position": [-4, 5, 6], **control}]
    return json.dumps({"@schema": "x", "markups": [{"type": "Fiducial", **system, "controlPoints": points}]})


PP = (
    '<!DOCTYPE PickedPoints>\n<PickedPoints>\n <DocumentData><User name="u"/></DocumentData>\n'
    ' <point x="1.5" y="2" z="3" active="1" name="LEC"/>\n <point name="MEC, low" z="6" y="5" x="-4"/>\n'
    ' <point x="0" y="0" z="0" active="0" name="unset"/>\n</PickedPoints>\n'
)
LPS = {"LEC": [1.5, 2, 3], "MEC, low": [-4, 5, 6]}
RAS = {"LEC": [-1.5, -2, 3], "MEC, low": [4, -5, 6]}
FILES: dict[str, tuple[str, str, dict[str, list[float]]]] = {
    "json": ("marks.json", json.dumps({"femur_01": LPS}), LPS),
    "csv": ("marks.csv", 'id,landmark,x,y,z\nfemur_01,LEC,1.5,2,3\nfemur_01,"MEC, low",-4,5,6\n', LPS),
    "csv with semicolons": ("marks.csv", "id;landmark;x;y;z\nfemur_01;LEC;1.5;2;3\nfemur_01;MEC, low;-4;5;6\n", LPS),
    "fcsv of old versions": ("femur_01.fcsv", FCSV.format(frame="# CoordinateSystem = 0\n"), RAS),
    "fcsv without a frame": ("femur_01.fcsv", FCSV.format(frame=""), RAS),
    "fcsv RAS": ("femur_01.fcsv", FCSV.format(frame="# CoordinateSystem = RAS\n"), RAS),
    "fcsv LPS": ("femur_01.fcsv", FCSV.format(frame="# CoordinateSystem = LPS\n"), LPS),
    "fcsv 1": ("femur_01.fcsv", FCSV.format(frame="# CoordinateSystem = 1\n"), LPS),
    "mrk LPS": ("femur_01.mrk.json", mrk({"coordinateSystem": "LPS", "coordinateUnits": "mm"}), LPS),
    "mrk RAS": ("femur_01.mrk.json", mrk({"coordinateSystem": "RAS"}), RAS),
    "mrk without a frame": ("femur_01.mrk.json", mrk({}), LPS),
    "mrk with a point not placed": ("femur_01.mrk.json", mrk({}, positionStatus="undefined"), {"LEC": [1.5, 2, 3]}),
    "meshlab": ("femur_01.pp", PP, LPS),
    "scalismo": ("femur_01.json", json.dumps([{"id": k, "coordinates": v} for k, v in LPS.items()]), LPS),
}


@pytest.mark.parametrize("name", FILES)
def test_every_format_gives_the_same_points(name: str, tmp_path: Path) -> None:
    file, text, expected = FILES[name]
    (tmp_path / file).write_text(text)
    for path in (tmp_path / file, tmp_path):  # the folder with that one file is the same table
        table = read_landmarks(path)
        assert list(table) == ["femur_01"]
        assert {k: v.tolist() for k, v in table["femur_01"].items()} == expected


def test_folder_of_single_files(tmp_path: Path) -> None:
    (tmp_path / "femur_02.fcsv").write_text(FCSV.format(frame=""))
    (tmp_path / "femur_01.pp").write_text(PP)
    (tmp_path / "notes.txt").write_text("not a landmark file")
    assert list(read_landmarks(tmp_path)) == ["femur_01", "femur_02"]
    (tmp_path / "femur_02.mrk.json").write_text(mrk({}))
    with pytest.raises(ArtifactError, match=r"'femur_02' occurs again in femur_02\.mrk\.json"):
        read_landmarks(tmp_path)


def test_plane_landmarks_have_two_coordinates(tmp_path: Path) -> None:
    (tmp_path / "l.csv").write_text("id,landmark,x,y\nmouse01,L1,168.59,35.66\n")
    assert np.array_equal(read_landmarks(tmp_path / "l.csv")["mouse01"]["L1"], [168.59, 35.66])


def test_landmarks_that_were_not_placed_are_left_out(tmp_path: Path) -> None:
    (tmp_path / "l.csv").write_text("ID;Landmark;X;Y\nm1;A;1;2\nm1;B;;\nm2;A;NA;NA\nm2;B;3;4\nm3;A;-;nan\n")
    table = read_landmarks(tmp_path / "l.csv")
    assert {i: sorted(points) for i, points in table.items()} == {"m1": ["A"], "m2": ["B"], "m3": []}
    (tmp_path / "l.csv").write_text("id,landmark,x,y\nm1,A,1,\n")
    with pytest.raises(ArtifactError, match="line 2, shape 'm1', landmark 'A'"):
        read_landmarks(tmp_path / "l.csv")


BAD: dict[str, tuple[str, str]] = {
    "no.json": ("{", "no.json is not readable JSON"),
    "flat.json": ('{"a": [1, 2, 3]}', "not a landmark table"),
    "short.json": ('{"f1": {"LEC": [1]}}', "short.json, shape 'f1', landmark 'LEC': 1 coordinates"),
    "word.json": ('{"f1": {"LEC": ["x", 1, 2]}}', "word.json, shape 'f1', landmark 'LEC'"),
    "none.json": ('{"f1": {"LEC": null}}', "none.json, shape 'f1', landmark 'LEC'"),
    "nan.json": ('{"f1": {"LEC": [NaN, 1, 2]}}', "landmark 'LEC': a coordinate is not finite"),
    "list.json": ("[1]", "not a landmark list"),
    "twice.csv": ("id,landmark,x,y\nf1,LEC,1,2\nf1,LEC,1,2\n", "line 3, shape 'f1': landmark 'LEC' occurs twice"),
    "word.csv": ("id,landmark,x,y\nf1,LEC,1,two\n", "line 2, shape 'f1', landmark 'LEC'"),
    "column.csv": ("id,name,x,y\nf1,LEC,1,2\n", "no column landmark"),
    "ijk.fcsv": (FCSV.format(frame="# CoordinateSystem = IJK\n"), "coordinate system 'IJK'"),
    "short.fcsv": ("1,2,3\n", "line 1: no x, y, z and label"),
    "inches.mrk.json": (mrk({"coordinateUnits": "in"}), "in 'in'"),
    "null.mrk.json": (mrk({}, position=None), "landmark 'MEC, low'"),
    "nolabel.mrk.json": (mrk({}, label=""), "no name"),
    "broken.pp": ("<PickedPoints>", "not readable XML"),
    "bomb.pp": ('<!DOCTYPE a [<!ENTITY b "c">]><a/>', "XML entities"),
    "noz.pp": ('<PickedPoints><point x="1" y="2" name="LEC"/></PickedPoints>', "noz.pp, landmark 'LEC'"),
    "marks.xlsx": ("", "unknown kind"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_file_is_refused_by_name(name: str, tmp_path: Path) -> None:
    text, words = BAD[name]
    (tmp_path / name).write_text(text)
    with pytest.raises(ArtifactError, match=words):
        read_landmarks(tmp_path / name)


def test_folder_without_landmarks_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match="has no landmark files"):
        read_landmarks(tmp_path)


def test_real_landmark_tables_load() -> None:
    data = Path(__file__).parents[2] / "../shared/data"
    if not data.is_dir():
        pytest.skip("../shared/data is not on this machine")
    assert len(read_landmarks(data / "femur_vsd/landmarks.json")) == 12
    assert read_landmarks(data / "mouse_vertebra/landmarks.csv")["mouse01"]["L6"].shape == (2,)
