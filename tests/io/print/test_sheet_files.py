"""Printed sheets: the files themselves, and detection after rasterising and photographing them."""

from __future__ import annotations

import io
import math
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import cv2
import ezdxf
import numpy as np
import pypdfium2
import pytest
import resvg_py
from matplotlib.textpath import TextPath
from PIL import Image
from scipy.spatial.transform import Rotation

from kgcp.errors import SettingError
from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.io.print.drawing import check_pixels, pdf_of, png_of, svg_of
from kgcp.io.print.dxf import dxf_of
from kgcp.io.print.typeface import fit_text, font
from kgcp.io.print.write import FORMATS, check_stems, file_stem, write_sheets
from kgcp.measurement.records import Measurement, Miss
from kgcp.pipeline.measure import measure_frame
from kgcp.settings import DetectSettings
from kgcp.targets.artwork import MountingPlate, draw_target
from kgcp.targets.layout import Ring, Target
from kgcp.targets.shapes import Artwork, Box, Circle, Layer, Sheet, Text, filled_rectangle
from kgcp.targets.sheets import Paper, lay_out
from kgcp.targets.validation import check_targets

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
DPI = 600
PX_PER_MM = DPI / 25.4
RING = Ring("Südtor 1", 0.09, 0.045, 0.0643, 0.0129, (0.0, 47.0, 100.0, 260.0))
TARGET = Target(RING, (RING.scaled("inner", 0.3, (0.0, 70.0, 190.0)),))


def sheet_of(target: Target = TARGET, paper: Paper = Paper.FIT) -> Sheet:
    return lay_out(draw_target(target, None), target.name, paper, is_tiled=False)[0]


def raster_of_pdf(sheet: Sheet, dpi: int) -> GreyArray:
    (page,) = pypdfium2.PdfDocument(pdf_of([sheet], "test"))
    return np.asarray(page.render(scale=dpi / 72.0, grayscale=True).to_pil().convert("L"))


def raster_of_svg(sheet: Sheet, dpi: int) -> GreyArray:
    picture = resvg_py.svg_to_bytes(svg_string=svg_of(sheet).decode(), dpi=float(dpi))
    return np.asarray(Image.open(io.BytesIO(bytes(picture))).convert("L"))


def raster_of_png(sheet: Sheet, dpi: int) -> GreyArray:
    return np.asarray(Image.open(io.BytesIO(png_of(sheet, dpi))))


def edges(profile: FloatArray) -> FloatArray:
    """Where a profile crosses the middle of black and white, in samples."""
    above = profile - 127.5
    before = np.flatnonzero(above[:-1] * above[1:] < 0.0)
    crossings: FloatArray = before + above[before] / (above[before] - above[before + 1])
    return crossings


def bare_sheet() -> Sheet:
    """A target without its legend, which needs no measuring."""
    bare = replace(draw_target(TARGET, None), box=Box(-46.0, -47.0, 48.0, 49.0))
    return lay_out(bare, "bare", Paper.FIT, is_tiled=False)[0]


def edges_mm(grey: GreyArray, sheet: Sheet, px_per_mm: FloatArray, way_deg: float) -> FloatArray:
    """Distances of all edges on a line through the centre, from it; negative ones first."""
    centre = np.array(sheet.centre_mm) * px_per_mm - 0.5
    reach_mm = np.arange(-50.0, 50.0, 0.02)
    way = math.radians(way_deg)
    steps = reach_mm[:, None] * np.array([math.cos(way), math.sin(way)])
    places = (centre + steps * px_per_mm).astype(np.float32)
    profile = cv2.remap(grey, places[None, :, 0], places[None, :, 1], cv2.INTER_LINEAR)[0]
    found = np.interp(edges(profile.astype(float)), np.arange(len(reach_mm)), reach_mm)
    return np.asarray(found)


DIAMETERS_MM = np.array([90.0, 45.0, 27.0, 13.5])
BETWEEN_DOTS_DEG = (28.0, 122.0, 140.0, 160.0)


@pytest.mark.parametrize(
    ("rasterise", "is_stretched"),
    [(raster_of_pdf, True), (raster_of_svg, True), (raster_of_png, False)],
)
def test_diameters_are_true_at_600_dpi(
    rasterise: Callable[[Sheet, int], GreyArray], *, is_stretched: bool
) -> None:
    """Rasterisers differ in whether they stretch a page to whole pixels."""
    sheet = bare_sheet()
    grey = rasterise(sheet, DPI)
    page_px = np.array(grey.shape[::-1])
    np.testing.assert_allclose(page_px / PX_PER_MM, (sheet.width_mm, sheet.height_mm), atol=0.05)
    scale = np.full(2, PX_PER_MM)
    if is_stretched:
        scale = page_px / (sheet.width_mm, sheet.height_mm)
    for way_deg in BETWEEN_DOTS_DEG:
        edge_mm = edges_mm(grey, sheet, scale, way_deg)
        assert len(edge_mm) == 8
        np.testing.assert_allclose(edge_mm[::-1][:4] - edge_mm[:4], DIAMETERS_MM, atol=0.02)
        np.testing.assert_allclose(edge_mm[:4], -0.5 * DIAMETERS_MM, atol=0.02)


@pytest.mark.parametrize("place_mm", [(50.0, 50.0), (50.013, 49.979)])
def test_painted_circles_have_their_radius_and_centre(place_mm: tuple[float, float]) -> None:
    """By area and centre of mass of the ink, whose edges are grey."""
    radius_mm = 45.0
    disc = Artwork(
        (Circle(Layer.INK, (0.0, 0.0), radius_mm, is_filled=True),), Box(-45.0, -45.0, 45.0, 45.0)
    )
    sheet = Sheet("", 100.0, 100.0, disc, place_mm, Box(0.0, 0.0, 100.0, 100.0))
    ink = 1.0 - raster_of_png(sheet, DPI) / 255.0
    assert math.sqrt(ink.sum() / math.pi) / PX_PER_MM == pytest.approx(radius_mm, abs=2e-3)
    pixels_mm = (np.arange(len(ink)) + 0.5) / PX_PER_MM
    weights = ink / ink.sum()
    centre_mm = (weights.sum(axis=0) @ pixels_mm, weights.sum(axis=1) @ pixels_mm)
    assert centre_mm == pytest.approx(place_mm, abs=1e-3)


def circles_mm(svg: str) -> list[FloatArray]:
    """Points (16, 2) of each circle, which are the ends of cubic curves."""
    paths = re.findall(r'<path d="([^"]*)"', svg)
    ends_pt = [re.findall(r"C .* ([\d.]+) ([\d.]+) $", path, re.MULTILINE) for path in paths]
    return [25.4 / 72.0 * np.array(ends, dtype=float) for ends in ends_pt if len(ends) == 16]


def test_circles_of_the_svg_are_true_to_a_micrometre() -> None:
    sheet = bare_sheet()
    circles = circles_mm(svg_of(sheet).decode())
    diameters_mm = [*DIAMETERS_MM]
    diameters_mm += [1e3 * ring.dot_diameter_m for ring in TARGET.rings for _ in ring.code_deg]
    sizes_mm = [np.ptp(points, axis=0).max() for points in circles]
    np.testing.assert_allclose(sorted(sizes_mm), sorted(diameters_mm), atol=1e-3)
    outer = circles[int(np.argmax(sizes_mm))]
    radii_mm = np.linalg.norm(outer - np.array(sheet.centre_mm), axis=1)
    np.testing.assert_allclose(radii_mm, 45.0, atol=1e-3)


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_a_browser_draws_the_svg_at_its_true_size(tmp_path: Path) -> None:
    assert CHROMIUM is not None
    sheet, picture = bare_sheet(), tmp_path / "seen.png"
    (tmp_path / "sheet.svg").write_bytes(svg_of(sheet))
    seen = subprocess.run(
        [
            *(CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"),
            *("--enable-logging=stderr", f"--user-data-dir={tmp_path / 'profile'}"),
            *("--window-size=600,600", f"--screenshot={picture}"),
            (tmp_path / "sheet.svg").as_uri(),
        ],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert "CONSOLE" not in seen.stderr
    with Image.open(picture) as opened:
        grey = np.asarray(opened.convert("L"))
    css_px_per_mm = np.full(2, 96.0 / 25.4)  # and pages are rounded to whole ones, of 0.26 mm
    for way_deg in BETWEEN_DOTS_DEG:
        found_mm = edges_mm(grey, sheet, css_px_per_mm, way_deg)
        np.testing.assert_allclose(found_mm[:4], -0.5 * DIAMETERS_MM, atol=0.2)
        np.testing.assert_allclose(found_mm[::-1][:4], 0.5 * DIAMETERS_MM, atol=0.2)


def random_targets(count: int) -> tuple[Target, ...]:
    """Random codes that flight.toml would accept beside each other."""
    rng = np.random.default_rng(7)
    targets: list[Target] = []
    while len(targets) < count:
        dots = int(rng.integers(3, 6))
        gaps = 33.0 + (360.0 - dots * 33.0) * rng.dirichlet(np.ones(dots))
        code = tuple(np.round(np.cumsum(gaps) - gaps[0], 1))
        ring = Ring(f"N{len(targets)}", 0.12, 0.06, 0.12 / 1.4, 0.12 / 7.0, code)
        with suppress(SettingError):
            check_targets((*targets, Target(ring)))
            targets.append(Target(ring))
    return tuple(targets)


TARGETS = random_targets(10)
CAMERA = Camera(480, 360, 700.0, 703.0, 241.3, 176.8)
_FINE = 2


def cluttered(rng: np.random.Generator) -> FloatArray:
    """A photo-like background: structures of all sizes, from soil to fields."""
    height, width = _FINE * CAMERA.height, _FINE * CAMERA.width
    light = np.full((height, width), 0.38)
    for size in (4, 9, 20, 45, 100, 220):
        cells = rng.normal(0.0, 0.05, (size * 3 // 4, size)).astype(np.float32)
        light += cv2.resize(cells, (width, height), interpolation=cv2.INTER_CUBIC)
    for _ in range(25):
        x, y, r = rng.uniform((0, 0, 5), (width, height, 60)).astype(int)
        cv2.circle(light, (int(x), int(y)), int(r), float(rng.uniform(0.05, 0.8)), -1, cv2.LINE_AA)
    return np.asarray(light)


def photograph(print_grey: GreyArray, sheet: Sheet, pose: Pose, seed: int) -> GreyArray:
    """Put a printed sheet into a frame, in perspective."""
    rng = np.random.default_rng(seed)
    px_per_m = 1e3 * print_grey.shape[1] / sheet.width_mm
    x0, y0 = (np.array(sheet.centre_mm) * print_grey.shape[1] / sheet.width_mm) - 0.5
    plate_from_print = np.array([[1.0, 0.0, -x0], [0.0, 1.0, -y0], [0.0, 0.0, px_per_m]])
    camera = np.array([[CAMERA.fx, 0.0, CAMERA.cx], [0.0, CAMERA.fy, CAMERA.cy], [0.0, 0.0, 1.0]])
    fine = np.array([[_FINE, 0, (_FINE - 1) / 2], [0, _FINE, (_FINE - 1) / 2], [0, 0, 1.0]])
    plate = np.column_stack((pose.rotation[:, :2], pose.translation_m))
    homography = fine @ camera @ plate @ plate_from_print
    size = (_FINE * CAMERA.width, _FINE * CAMERA.height)
    printed = 0.05 + 0.8 * print_grey / 255.0
    seen = cv2.warpPerspective(printed, homography, size, flags=cv2.INTER_LINEAR)
    share = cv2.warpPerspective(np.ones_like(printed), homography, size, flags=cv2.INTER_LINEAR)
    light = seen + (1.0 - share) * cluttered(rng)
    light = np.asarray(cv2.GaussianBlur(light, (0, 0), 0.7 * _FINE), dtype=float)
    frame = cv2.resize(light, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA)
    frame = frame + rng.normal(0.0, 0.006, frame.shape)
    return np.asarray(np.clip(np.rint(230.0 * frame), 0, 255).astype(np.uint8))


@pytest.mark.parametrize("number", range(len(TARGETS)))
def test_printed_targets_are_found_with_their_code(number: int) -> None:
    """From the file to the measurement: right code, right heading, right scale."""
    rng = np.random.default_rng(100 + number)
    sheet = sheet_of(TARGETS[number])
    rasterise = (raster_of_pdf, raster_of_svg)[number % 2]
    radius_px = rng.uniform(22.0, 45.0)
    distance_m = 0.06 * CAMERA.mean_focal_px / radius_px
    turn = Rotation.from_euler("z", rng.uniform(0.0, 360.0), degrees=True)
    tilt = Rotation.from_rotvec(np.radians([*rng.uniform(-18.0, 18.0, 2), 0.0]))
    x, y = rng.uniform((150.0, 120.0), (330.0, 240.0))
    ray = np.array([(x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, 1.0])
    pose = Pose((tilt * turn).as_matrix(), distance_m * ray / np.linalg.norm(ray))
    frame = photograph(rasterise(sheet, 127), sheet, pose, number)
    outcomes = measure_frame(frame, CAMERA, TARGETS, DetectSettings())
    found = [outcome for outcome in outcomes if isinstance(outcome, Measurement)]
    assert [observation.target for observation in found] == [TARGETS[number].name]
    assert all(isinstance(outcome, Miss) for outcome in outcomes if outcome not in found)
    assert found[0].pose.distance_m == pytest.approx(distance_m, rel=2e-3)
    turned = found[0].pose.rotation @ pose.rotation.T
    assert np.degrees(Rotation.from_matrix(turned).magnitude()) < 5.0


def test_dxf_is_read_back_with_its_circles_in_millimetres() -> None:
    artwork = draw_target(TARGET, MountingPlate(180.0, hole_mm=6.0))
    drawing = ezdxf.read(io.StringIO(dxf_of(artwork).decode("utf-8")))
    assert not drawing.audit().has_errors
    assert drawing.units == ezdxf.units.MM
    circles = [
        (c.dxf.layer, round(2.0 * c.dxf.radius, 4), tuple(round(v, 4) for v in c.dxf.center.xyz))
        for c in drawing.modelspace().query("CIRCLE")
    ]
    assert ("INK", 90.0, (0.0, 0.0, 0.0)) in circles
    assert ("WHITE", 45.0, (0.0, 0.0, 0.0)) in circles
    assert ("INK", 27.0, (0.0, 0.0, 0.0)) in circles
    assert sum(layer == "HOLES" and size == 6.0 for layer, size, _ in circles) == 4
    angle = math.radians(47.0)  # clockwise as seen: y is up in DXF
    where = (round(32.15 * math.cos(angle), 4), round(-32.15 * math.sin(angle), 4), 0.0)
    assert ("WHITE", 12.9, where) in circles
    words = [text.dxf.text for text in drawing.modelspace().query("TEXT")]
    assert "Südtor 1" in words


def test_svg_has_the_paper_s_size_and_needs_no_typeface() -> None:
    text = svg_of(sheet_of(paper=Paper.A4)).decode()
    size = re.search(r'<svg [^>]*width="([\d.]+)pt" height="([\d.]+)pt"', text)
    assert size is not None
    assert [25.4 / 72.0 * float(side) for side in size.groups()] == pytest.approx([210.0, 297.0])
    assert "Südtor 1" in text
    assert "<text" not in text


def test_pdf_has_a_page_for_each_tile_and_can_be_searched() -> None:
    tiles = lay_out(draw_target(TARGET, MountingPlate(400.0)), "Südtor 1", Paper.A4, is_tiled=True)
    document = pypdfium2.PdfDocument(pdf_of(tiles, "Target Südtor 1"))
    assert len(document) == len(tiles) > 1
    assert sorted(document[0].get_size()) == pytest.approx([595.28, 841.89], abs=0.01)
    assert "row 1 of" in document[0].get_textpage().get_text_bounded()
    assert "Südtor 1" in document[len(tiles) - 2].get_textpage().get_text_bounded()
    assert document.get_metadata_value("Title") == "Target Südtor 1"


def test_tiles_overlap_by_their_bleed_and_show_nothing_beyond_it() -> None:
    """Two tiles of a black square: each paints it up to 3 mm beyond the common cut."""
    square = Artwork(
        (filled_rectangle(Layer.INK, Box(-140.0, -50.0, 140.0, 50.0)),), Box(-140, -50, 140, 50)
    )
    sheets = lay_out(square, "x", Paper.A4, is_tiled=True)
    assert len(sheets) == 2
    for sheet, (left, right) in zip(sheets, ((-140.0, 3.0), (-3.0, 140.0)), strict=True):
        bare = replace(sheet, marks=())
        columns = np.flatnonzero(raster_of_png(bare, 254).min(axis=0) < 128)
        ends_mm = 0.1 * np.array([columns[0], columns[-1] + 1]) - sheet.centre_mm[0]
        np.testing.assert_allclose(ends_mm, (left, right), atol=0.06)


def test_png_carries_its_resolution(tmp_path: Path) -> None:
    (path,) = write_sheets([sheet_of()], "Südtor 1", tmp_path, ("png",), 150)
    with Image.open(path) as picture:
        assert picture.info["dpi"] == pytest.approx((150.0, 150.0), abs=0.02)
        assert picture.mode == "L"
        assert picture.width / 150.0 * 25.4 == pytest.approx(sheet_of().width_mm, abs=0.2)


def test_the_same_sheets_are_the_same_bytes(tmp_path: Path) -> None:
    sheets = lay_out(draw_target(TARGET, MountingPlate(200.0)), "A", Paper.A4, is_tiled=True)
    assert len(sheets) == 2
    first = write_sheets(sheets, "A", tmp_path / "1", FORMATS, 20)
    again = write_sheets(sheets, "A", tmp_path / "2", FORMATS, 20)
    assert [path.name for path in first] == [path.name for path in again]
    assert len(first) == 2 + 2 * len(sheets)
    for one, other in zip(first, again, strict=True):
        assert one.read_bytes() == other.read_bytes(), one.name


_DIGESTS = """
import hashlib
from pathlib import Path
from kgcp.io.print.write import FORMATS, write_sheets
from kgcp.targets.artwork import draw_target
from kgcp.targets.layout import Ring, Target
from kgcp.targets.sheets import Paper, lay_out
target = Target(Ring("T", 0.09, 0.045, 0.0643, 0.0129, (0.0, 47.0, 100.0, 260.0)))
sheets = lay_out(draw_target(target, None), "T", Paper.A4, is_tiled=False)
for path in write_sheets(sheets, "T", Path({folder!r}), FORMATS, 50):
    print(path.name, hashlib.sha256(path.read_bytes()).hexdigest())
"""


def test_the_bytes_do_not_depend_on_the_process(tmp_path: Path) -> None:
    """Sets of strings have another order in each process."""
    printed = {
        subprocess.run(
            [sys.executable, "-c", _DIGESTS.format(folder=str(tmp_path / seed))],
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, "PYTHONHASHSEED": seed},
        ).stdout
        for seed in ("1", "2", "5")
    }
    assert len(printed) == 1


def test_pictures_of_too_many_pixels_are_refused() -> None:
    check_pixels(1000.0, 1000.0, 500)
    with pytest.raises(SettingError, match=r"dpi: 1200 gives .* give at most 508"):
        check_pixels(1000.0, 1000.0, 1200)


def test_file_names_are_safe_and_differ() -> None:
    assert file_stem("A/../b c") == "target_A_.._b_c"
    check_stems(["A", "B"])
    with pytest.raises(SettingError, match="'a b' and 'A_B' would both have"):
        check_stems(["a b", "A_B"])


def test_text_fits_into_its_box_and_replaces_characters_it_cannot_write() -> None:
    words, size_mm = fit_text(Text("a very long name " * 9, (0.0, 0.0), 7.0, 50.0))
    outline = TextPath((0.0, 0.0), words, size=size_mm, prop=font(is_bold=False))
    assert outline.get_extents().x1 == pytest.approx(50.0, rel=0.01)
    unknown = Text("$x^2$ \U0001f6f8 Ω", (0.0, 0.0), 3.0, 99.0)
    assert fit_text(unknown) == ("$x^2$ ? Ω", 3.0)
