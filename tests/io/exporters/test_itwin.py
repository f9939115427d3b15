"""iTwin Capture: a strict reader of BlocksExchange 2.1, written from Bentley's documentation."""

from __future__ import annotations

import re
import runpy
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from kgcp.errors import KgcpError
from kgcp.io.exporters import itwin
from kgcp.io.exporters.points import MapPoints
from kgcp.io.exporters.write import export

Factory = Callable[..., MapPoints]

CHILDREN = {
    "BlocksExchange": {"SpatialReferenceSystems", "BaseImagePath", "Block"},
    "SpatialReferenceSystems": {"SRS"},
    "SRS": {"Id", "Name", "Definition"},
    "Block": {"Name", "Description", "Type", "SRSId", "Photogroups", "ControlPoints"},
    "Photogroups": {"Photogroup"},
    "Photogroup": {
        *("Name", "ImageDimensions", "CameraModelType", "CameraModelBand", "SensorSize"),
        *("FocalLength", "CameraOrientation", "PrincipalPoint", "Distortion", "Photo"),
    },
    "ImageDimensions": {"Width", "Height"},
    "PrincipalPoint": {"x", "y"},
    "Photo": {"Id", "ImagePath", "MaskPath", "Component", "Pose", "ExifData"},
    "ControlPoints": {"SRSId", "ControlPoint"},
    "ControlPoint": {
        *("Name", "SRSId", "Category", "Position", "CheckPoint"),
        *("HorizontalAccuracy", "VerticalAccuracy", "Measurement"),
    },
    "Position": {"x", "y", "z"},
    "Measurement": {"PhotoId", "x", "y"},
}


@dataclass(frozen=True)
class Control:
    """A control point as the format has it."""

    definition: str  # of its spatial reference system
    position: tuple[float, float, float]
    accuracies: tuple[float, float] | None  # horizontal, vertical
    is_check: bool
    marks: dict[str, tuple[float, float]]  # by the path of the image


def text_of(element: ET.Element, path: str) -> str:
    text = element.findtext(path)
    assert text, path
    return text


def read_block(path: Path) -> dict[str, Control]:
    root = ET.parse(path).getroot()  # noqa: S314 - has just been written
    assert (root.tag, root.get("version")) == ("BlocksExchange", "2.1")
    for element in root.iter():
        known = CHILDREN.get(element.tag, set())
        assert {child.tag for child in element} <= known, element.tag
        assert element.tag in CHILDREN or element.text
    systems = {text_of(each, "Id"): text_of(each, "Definition") for each in root.iter("SRS")}
    (block,) = root.findall("Block")
    photos = {text_of(each, "Id"): text_of(each, "ImagePath") for each in block.iter("Photo")}
    assert len(photos) == len([*block.iter("Photo")]), "ids are unique over the block"
    return {
        text_of(control, "Name"): read_control(control, block, systems, photos)
        for control in block.iterfind("ControlPoints/ControlPoint")
    }


def read_control(
    control: ET.Element, block: ET.Element, systems: dict[str, str], photos: dict[str, str]
) -> Control:
    x, y, z = (float(text_of(control, f"Position/{name}")) for name in "xyz")
    assert text_of(control, "Category") == "Full"
    marks = {
        photos[text_of(mark, "PhotoId")]: (float(text_of(mark, "x")), float(text_of(mark, "y")))
        for mark in control.findall("Measurement")
    }
    assert len(marks) == len(control.findall("Measurement")), "one in each photo"
    names = ("HorizontalAccuracy", "VerticalAccuracy")
    known = control.find(names[0]) is not None
    return Control(
        systems[control.findtext("SRSId") or text_of(block, "SRSId")],
        (x, y, z),
        (float(text_of(control, names[0])), float(text_of(control, names[1]))) if known else None,
        {"true": True, "false": False}[text_of(control, "CheckPoint")],
        marks,
    )


def test_the_xml_has_points_marks_and_accuracies(points: MapPoints, tmp_path: Path) -> None:
    export(points, "itwin", tmp_path)
    controls = read_block(tmp_path / "itwin/block.xml")
    assert [*controls] == ["K0001", "K0002", "K0003", "K0004", "K0005", "north_gate"]
    for point in points.gcps:
        control = controls[point.id.replace(" ", "_")]
        assert control.definition == "EPSG:25831"
        np.testing.assert_allclose(control.position, point.position_map, atol=1e-6, rtol=0)
        worst = (6.5 + np.sqrt(2.5**2 + 1.0**2)) * 1e-4  # eigenvalue of [[4, 1], [1, 9]] cm²
        assert control.accuracies == pytest.approx((np.sqrt(worst), 0.04), abs=1e-8)
        assert control.is_check is point.is_checkpoint
        # its (0, 0) is the centre of the upper-left pixel, as kgcp's
        assert control.marks[point.frame] == pytest.approx(tuple(point.centre_px), abs=1e-6)
    assert len(controls["north_gate"].marks) == 2


def test_the_camera_has_its_proportions(points: MapPoints) -> None:
    root = ET.fromstring(itwin.files(points)["itwin/block.xml"].encode())  # noqa: S314 - our own
    group = root.find("Block/Photogroups/Photogroup")
    assert group is not None
    pixel_mm = float(text_of(group, "SensorSize")) / 1600
    assert float(text_of(group, "FocalLength")) / pixel_mm == pytest.approx(2305.0)
    assert text_of(group, "ImageDimensions/Height") == "1201"
    assert float(text_of(group, "PrincipalPoint/x")) == pytest.approx(801.3)


def test_unknown_accuracies_are_left_out(points: MapPoints, tmp_path: Path) -> None:
    unknown = replace(points, gcps=(replace(points.gcps[0], cov_m2=None),))
    export(unknown, "itwin", tmp_path)
    assert read_block(tmp_path / "itwin/block.xml")["K0001"].accuracies is None


@pytest.mark.parametrize(
    ("crs", "definition"),
    [("EPSG:25831+5773", "EPSG:25831+5773"), ("+proj=tmerc +lat_0=41 +ellps=GRS80", "PROJCS[")],
)
def test_other_coordinate_systems_are_written(
    points: MapPoints, tmp_path: Path, crs: str, definition: str
) -> None:
    export(replace(points, crs=crs, priors=()), "itwin", tmp_path)
    control = read_block(tmp_path / "itwin/block.xml")["K0001"]
    assert control.definition.startswith(definition)


BLOCK = r"""<?xml version="1.0" encoding="utf-8"?>
<BlocksExchange version="2.1">
  <SpatialReferenceSystems>
    <SRS><Id>4</Id><Name>WGS 84</Name><Definition>EPSG:4326</Definition></SRS>
  </SpatialReferenceSystems>
  <Block>
    <Name>theirs</Name>
    <SRSId>4</SRSId>
    <Photogroups><Photogroup>
      <ImageDimensions><Width>1600</Width><Height>1201</Height></ImageDimensions>
      <Photo><Id>7</Id><ImagePath>D:\flight\IMG_9.JPG</ImagePath></Photo>
      <Photo><Id>8</Id><ImagePath>D:\flight\IMG_3.JPG</ImagePath></Photo>
      <Photo><Id>9</Id><ImagePath>D:\flight\IMG_1.JPG</ImagePath></Photo>
    </Photogroup></Photogroups>
    %s
  </Block>
</BlocksExchange>
"""
PILLAR = """<ControlPoints><ControlPoint><Name>pillar</Name><Category>Full</Category>
<Position><x>2.1</x><y>41.4</y><z>170</z></Position><CheckPoint>false</CheckPoint>
<Measurement><PhotoId>7</PhotoId><x>5</x><y>6</y></Measurement>
</ControlPoint></ControlPoints>"""


def add_to_block(
    points: MapPoints, folder: Path, block: str, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """Run the script as a user does; return the block that it writes."""
    export(points, "itwin", folder)
    (folder / "block_1.xml").write_text(block, encoding="utf-8")
    script = folder / "itwin/add_to_block.py"
    monkeypatch.setattr(sys, "argv", [str(script), str(folder / "block_1.xml")])
    runpy.run_path(str(script), run_name="__main__")
    return folder / "block_1_kgcp.xml"


@pytest.mark.parametrize("before", ["", PILLAR])
def test_the_script_adds_the_points_to_a_block(
    points: MapPoints,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    before: str,
) -> None:
    result = add_to_block(points, tmp_path, BLOCK % before, monkeypatch)
    again = add_to_block(points, tmp_path, result.read_text(encoding="utf-8"), monkeypatch)
    for path in (result, again):  # twice: the same points
        controls = read_block(path)
        assert [*controls] == [*(["pillar"] if before else []), "K0001", "K0003", "north_gate"]
        assert {control.definition for name, control in controls.items() if name != "pillar"} == {
            "EPSG:25831"
        }
        marks = controls["K0003"].marks
        assert marks == {r"D:\flight\IMG_3.JPG": pytest.approx((812.3456789, 77.7654321))}
        assert [*controls["north_gate"].marks] == [r"D:\flight\IMG_3.JPG"]
        if before:
            assert controls["pillar"].definition == "EPSG:4326"
            assert controls["pillar"].marks == {r"D:\flight\IMG_9.JPG": (5.0, 6.0)}
    text = capsys.readouterr().out
    assert "3 control points in" in text
    assert "4 photos are not in the block" in text
    assert "a/IMG_2.JPG, a/IMG_4.JPG, a/IMG_5.JPG, a/IMG_6.JPG" in text


def test_moving_points_of_an_earlier_export_are_removed(
    points: MapPoints,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    one = "<Measurement><PhotoId>7</PhotoId><x>5</x><y>6</y></Measurement>"
    names = {"K0099": one, "K0100": 2 * one, "south-K0099": one, "pillar": one}
    before = "".join(
        f"<ControlPoint><Name>{name}</Name>{marks}</ControlPoint>" for name, marks in names.items()
    )
    block = BLOCK % f"<ControlPoints>{before}</ControlPoints>"
    result = add_to_block(points, tmp_path, block, monkeypatch)
    document = result.read_text(encoding="utf-8")
    left = re.findall(r"<ControlPoint>\s*<Name>(.*?)<", document)
    assert left == ["K0100", "south-K0099", "pillar", "K0001", "K0003", "north_gate"]
    assert "moving points of an earlier export removed: 1" in capsys.readouterr().out


def test_equal_image_names_are_distinguished_by_their_folders(
    points: MapPoints, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second, third = points.gcps[:3]
    gcps = tuple(
        replace(point, frame=frame)
        for point, frame in (
            (first, "north/IMG_1.JPG"),
            (second, "south/IMG_1.JPG"),
            (third, "north/IMG_3.JPG"),
        )
    )
    block = (BLOCK % "").replace(r"flight\IMG_1.JPG", r"south\IMG_1.JPG")
    result = add_to_block(replace(points, gcps=gcps, priors=()), tmp_path, block, monkeypatch)
    controls = read_block(result)
    assert [*controls] == ["K0002", "K0003"], "the north's IMG_1 is not in the block"
    assert [*controls["K0002"].marks] == [r"D:\south\IMG_1.JPG"]
    assert [*controls["K0003"].marks] == [r"D:\flight\IMG_3.JPG"]


def test_the_script_refuses_other_files(
    points: MapPoints, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(SystemExit, match="is not a block in BlocksExchange XML"):
        add_to_block(points, tmp_path, "<kml/>", monkeypatch)


def test_a_crs_without_a_form_is_refused(points: MapPoints) -> None:
    nameless = (
        'DERIVEDPROJCRS["d",BASEPROJCRS["p",BASEGEOGCRS["b",DATUM["d",ELLIPSOID["GRS80",6378137,'
        '298.257222101]]],CONVERSION["c",METHOD["Transverse Mercator"],PARAMETER["Latitude of'
        ' natural origin",41,ANGLEUNIT["degree",0.0174532925199433]]]],DERIVINGCONVERSION["s",'
        'METHOD["Affine parametric transformation"],PARAMETER["A0",1,LENGTHUNIT["metre",1]]],'
        'CS[Cartesian,2],AXIS["e",east],AXIS["n",north],LENGTHUNIT["metre",1]]'
    )
    with pytest.raises(KgcpError, match="no form that iTwin Capture reads"):
        itwin.files(replace(points, crs=nameless, priors=()))
