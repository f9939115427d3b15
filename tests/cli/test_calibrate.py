"""kgcp calibrate, from rendered photographs to the camera that took them."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner, Result
from PIL import ExifTags, Image

from kgcp.cli import main
from kgcp.cli.calibrate import FORMATS, LENSES, OPERATORS, POINT_MODELS, RESPONSES
from kgcp.errors import KgcpError
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.pose import Pose, rotation_about
from kgcp.io.flight.camera_table import read_camera_file
from kgcp.io.flight.flight import read_camera_and_targets, read_flight
from kgcp.io.formats.camera_writers import CAMERA_FORMATS, CalibratedCamera, camera_file
from kgcp.measurement.discs.records import Operator
from kgcp.network.calibration_records import LensModel, PointModel
from kgcp.pipeline.check import doubts_before_detecting
from kgcp.quality.checks.calibration import CalibrationGrade
from kgcp.quality.checks.doubt import Cause
from kgcp.simulation.disc_field import FieldScene, SimulatedDisc, photograph
from kgcp.simulation.imaging import Optics, Sensor
from kgcp.targets.fields.layout import Field, GridKind, Mark
from tests.test_docs import first_column, section

pytestmark = pytest.mark.usefixtures("fewest_sub_pixels")

CAMERA = Camera(400, 300, 390.0, 390.0, 204.2, 146.5, -0.08, response=Response.LINEAR)
FIELD = Field("f", GridKind.SQUARE, 5, 4, 0.03, 0.016, marks=(Mark(1, 1, 0.016, 0.007),))
FIELD_TOML = """\
diameter_m = 0.016
[grid]
kind = "square"
columns = 5
rows = 4
pitch_m = 0.03
[[mark]]
at = [1, 1]
inner_diameter_m = 0.007
"""
TARGET_TOML = """\
[[target]]
name = "A"
outer_diameter_m = 0.9
inner_diameter_m = 0.45
code_diameter_m = 0.64
dot_diameter_m = 0.13
code_deg = [0, 43, 78, 180]
"""
TILTS = ((0.5, 0.0), (0.0, 0.5), (-0.5, 0.1), (0.1, -0.5), (0.35, 0.35))
RUN = "kgcp.pipeline.calibration.run"
QUIET = ("--jobs", "0", "--response", "linear", "--quiet")
# for tests of anything else: as accurate as needed, and the lens and the sheet are not studied
SIMPLE = ("--points", "fixed", "--model", "radial")
FASTEST = (*SIMPLE, "--operator", "centroid")


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["calibrate", *map(str, arguments)], catch_exceptions=False)


@pytest.fixture
def _no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave figures to the tests of the page: to draw them takes longer than to calibrate."""
    names = ("residuals", "photographs", "rays", "distortion", "eccentricity")
    monkeypatch.setattr(
        "kgcp.pipeline.calibration.results.draw_figures", lambda *_: dict.fromkeys(names, b"")
    )


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five photographs of a field, one of nothing, and one file that is none."""
    folder = tmp_path_factory.mktemp("photos")
    take_photographs(folder, CAMERA)
    cv2.imwrite(str(folder / "photo10.png"), np.full((300, 400), 180, dtype=np.uint8))
    (folder / "photo11.png").write_bytes(b"nothing")
    (folder / "field.toml").write_text(FIELD_TOML)
    return folder


def take_photographs(folder: Path, camera: Camera) -> None:
    """Render the field, tilted five times and turned every other time."""
    rng = np.random.default_rng(18)
    discs = tuple(
        SimulatedDisc(tuple(point), 2.0 * radius, 2.0 * inner)
        for point, radius, inner in zip(
            FIELD.points_m().tolist(),
            FIELD.radii_m().tolist(),
            FIELD.inner_radii_m().tolist(),
            strict=True,
        )
    )
    scene = FieldScene(discs)
    middle = FIELD.points_m().mean(axis=0)
    sensor = Sensor()
    for index, tilt in enumerate(TILTS):
        turn = rotation_about(np.array([0.0, 0.0, 0.5 * np.pi * (index % 2)]))
        rotation = rotation_about(np.array([*tilt, 0.0])) @ turn
        shift = np.array([0.01 * (index - 2), 0.004 * index, 0.21])
        grey = photograph(
            camera, Pose(rotation, shift - rotation @ middle), scene, Optics(0.6), sensor, rng
        )
        Image.fromarray(grey).save(folder / f"photo{index + 1}.png", exif=exif_of(24.0))


def exif_of(focal_mm: float) -> Image.Exif:
    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = "Maker", "M1"
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLength] = focal_mm
    return exif


@pytest.fixture(scope="module")
def calibration(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    """The results, and what was printed."""
    out = tmp_path_factory.mktemp("out")
    formats = [word for form in FORMATS for word in ("--format", form)]
    field = photos / "field.toml"
    result = run(photos, "--field", field, "--out", out, *QUIET, "--json", *formats)
    assert result.exit_code == 0, result.output
    return out, result


def test_the_camera_is_the_one_that_took_the_photographs(
    calibration: tuple[Path, Result],
) -> None:
    stated = read_camera_file(calibration[0] / "camera.toml")
    camera, covariance = stated.camera, stated.covariance
    assert covariance is not None
    sd = np.sqrt(covariance.cov.diagonal())
    errors = np.array([camera.fx - 390.0, camera.fy - 390.0, camera.cx - 204.2, camera.cy - 146.5])
    assert np.all(np.abs(errors) < 4.0 * sd[:4])
    assert np.all(sd[:4] < [2.0, 2.0, 2.0, 2.0])
    assert camera.k1 == pytest.approx(-0.08, abs=0.03)


def test_every_photograph_has_its_row(calibration: tuple[Path, Result]) -> None:
    summary = json.loads(calibration[1].stdout)
    assert summary["photographs"] == 7
    assert summary["photographs_used"] == 5
    assert summary["not_used"] == {"photo10.png": "too_few", "photo11.png": "decode_failed"}
    assert list(summary["photo_rms_px"]) == [f"photo{i}.png" for i in range(1, 6)]
    assert 0.001 < summary["rms_px"] < 0.2
    assert {Path(name).name for name in summary["files"]} >= {
        *("camera.toml", "field.toml", "field.csv", "calibration.json", "calibration.html"),
        *("observations.parquet", "field.parquet", "photos.parquet", "opencv.yml"),
    }


def test_exactly_the_numbers_that_exist_are_documented(calibration: tuple[Path, Result]) -> None:
    numbers = json.loads((calibration[0] / "calibration.json").read_text(encoding="utf-8"))
    assert numbers.keys() | {"against"} == set(first_column(section("calibration.json")))


def test_the_tables_state_versions(calibration: tuple[Path, Result]) -> None:
    for name in ("photos", "field", "observations"):
        metadata = pq.read_schema(calibration[0] / f"{name}.parquet").metadata
        assert sorted(metadata) == [b"kgcp.schema_version", b"kgcp.version"]


def test_the_page_is_self_contained_and_complete(calibration: tuple[Path, Result]) -> None:
    page = (calibration[0] / "calibration.html").read_text(encoding="utf-8")
    # with the colon, as figures in base64 may happen to contain the letters
    assert not re.search("https?:", page.replace("http://www.w3.org", ""))
    for name in (
        "The camera",
        "Shape of the field",
        "Eccentricity",
        "photo11.png",
        "decode_failed",
    ):
        assert name in page


@pytest.mark.parametrize("form", ['format = "kgcp"', ""], ids=["named", "by suffix"])
def test_flight_toml_takes_the_camera_with_its_covariance(
    calibration: tuple[Path, Result], tmp_path: Path, form: str
) -> None:
    out, _ = calibration
    shutil.copy(out / "camera.toml", tmp_path)
    toml = f'[camera]\nfile = "camera.toml"\n{form}\n{TARGET_TOML}'
    (tmp_path / "flight.toml").write_text(toml)
    camera, covariance, _ = read_camera_and_targets(tmp_path)
    own = read_camera_file(out / "camera.toml")
    own_camera, own_covariance = own.camera, own.covariance
    assert camera == own_camera
    assert camera.response is Response.LINEAR
    assert covariance is not None
    assert own_covariance is not None
    assert np.array_equal(covariance.cov, own_covariance.cov)
    (tmp_path / "flight.toml").write_text(toml.replace("[camera]", "[camera]\nwidth = 400"))
    with pytest.raises(KgcpError, match="width: is given beside a camera"):
        read_camera_and_targets(tmp_path)


@pytest.mark.parametrize(
    ("focal_mm", "verdict", "codes"),
    [
        (24.4, CalibrationGrade.GOOD, []),  # the focus may change the focal length a little
        (28.0, CalibrationGrade.GOOD, [Cause.OTHER_CAMERA]),
        (24.0, CalibrationGrade.LOOK, [Cause.CALIBRATION_VERDICT]),
    ],
)
def test_a_flight_doubts_its_camera_by_what_the_calibration_says(
    calibration: tuple[Path, Result],
    tmp_path: Path,
    focal_mm: float,
    verdict: CalibrationGrade,
    codes: list[Cause],
) -> None:
    toml = (calibration[0] / "camera.toml").read_text(encoding="utf-8")
    told = f'verdict = "{json.loads(calibration[1].stdout)["verdict"]}"'
    assert told in toml
    (tmp_path / "camera.toml").write_text(toml.replace(told, f'verdict = "{verdict}"'))
    (tmp_path / "flight.toml").write_text(f'[camera]\nfile = "camera.toml"\n{TARGET_TOML}')
    (tmp_path / "frames").mkdir()
    frame = Image.new("L", (CAMERA.width, CAMERA.height))
    frame.save(tmp_path / "frames" / "1.jpg", exif=exif_of(focal_mm))
    assert [doubt.code for doubt in doubts_before_detecting(read_flight(tmp_path))] == codes


@pytest.mark.usefixtures("_no_figures")
def test_the_same_photographs_give_the_same_bytes(
    photos: Path, calibration: tuple[Path, Result], tmp_path: Path
) -> None:
    result = run(photos, "--field", photos / "field.toml", "--out", tmp_path, *QUIET)
    assert result.exit_code == 0, result.output
    for name in ("camera.toml", "calibration.json", "observations.parquet", "field.csv"):
        assert (tmp_path / name).read_bytes() == (calibration[0] / name).read_bytes(), name
    assert not list(tmp_path.glob(".*"))  # no journal is left


@pytest.mark.usefixtures("_no_figures")
def test_a_format_with_one_focal_length_does_not_force_it_on_the_camera(tmp_path: Path) -> None:
    folder, out = tmp_path / "photos", tmp_path / "out"
    folder.mkdir()
    take_photographs(folder, replace(CAMERA, fy=370.0))
    (folder / "field.toml").write_text(FIELD_TOML)
    formats = ("--format", "pix4d", "--format", "opencv", "--format", "mmvii")
    chosen = (*QUIET, "--points", "fixed", "--operator", "centroid", "--json", *formats)
    result = run(folder, "--field", folder / "field.toml", "--out", out, *chosen)
    assert result.exit_code == 1
    assert result.stderr.startswith(
        "kgcp: error: pix4d, mmvii: left out, because fx and fy differ by "
    )
    assert result.stderr.endswith("or calibrate with one focal length (--same-aspect)\n")
    assert result.stderr.count("\n") == 1
    told = json.loads(result.stdout)
    assert list(told["left_out"]) == ["pix4d", "mmvii"]
    assert told["not_used"] == {}
    written = {Path(name).name for name in told["files"]}
    assert written == {path.name for path in out.iterdir()} >= {"camera.toml", "opencv.yml"}
    camera = read_camera_file(out / "camera.toml").camera
    assert camera.fx == pytest.approx(390.0, abs=2.0)
    assert camera.fy == pytest.approx(370.0, abs=2.0)


@pytest.mark.usefixtures("_no_figures")
def test_cameras_of_an_earlier_run_are_named(photos: Path, tmp_path: Path) -> None:
    (tmp_path / "opencv.yml").write_text("older")
    options = ("--jobs", "0", "--response", "linear", *FASTEST, "--format", "ros")
    result = run(photos, "--field", photos / "field.toml", "--out", tmp_path, *options, "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["not_renewed"] == ["opencv"]
    assert "not updated, from an earlier calibration: opencv" in result.stderr
    machines = ("--json", "--log-json")
    result = run(photos, "--field", photos / "field.toml", "--out", tmp_path, *options, *machines)
    logged = json.loads(result.stderr.splitlines()[-1])
    assert logged["event"] == "summary"
    told = json.loads(result.stdout)
    assert {key: logged[key] for key in told} == told
    assert str(tmp_path / "camera.toml") in logged["files"]


@pytest.mark.usefixtures("_no_figures")
def test_the_field_may_be_free_and_the_lens_chosen(photos: Path, tmp_path: Path) -> None:
    chosen = ("--points", "free", "--model", "radial", "--operator", "centroid")
    field = photos / "field.toml"
    result = run(photos, "--field", field, "--out", tmp_path, *QUIET, *chosen, "--json")
    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)
    assert summary["points"] == "free"
    assert summary["estimated"] == ["fx", "cx", "cy", "k1", "k2"]
    assert summary["flatness_m"] < 0.001
    assert summary["camera"]["fx"] == pytest.approx(390.0, abs=3.0)


def test_another_calibration_is_compared_with(
    photos: Path, calibration: tuple[Path, Result], tmp_path: Path
) -> None:
    """With itself there is no difference; with a longer lens, one that grows outwards."""
    own = calibration[0] / "camera.toml"
    field = photos / "field.toml"
    camera = read_camera_file(own).camera
    longer = tmp_path / "longer.yml"
    zoomed = replace(camera, fx=1.01 * camera.fx, fy=1.01 * camera.fy)
    calibrated = CalibratedCamera(zoomed, np.eye(12), 0.0)
    longer.write_text(camera_file(calibrated, "opencv")[1])
    out = tmp_path / "out"
    result = run(
        photos, "--field", field, "--out", out, *QUIET, *FASTEST, "--json", "--against", longer
    )
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)["against"]
    assert told["file"] == "longer.yml"
    assert told["change"]["fx"] == pytest.approx(-3.9, abs=1.5)
    assert 0.3 < told["rms_px"] < told["largest_px"] < 4.0
    assert re.match(r"Its focal length is (0\.9|1)\d* % longer, as with", told["convention"])
    page = (out / "calibration.html").read_text(encoding="utf-8")
    assert "Against longer.yml" in page
    assert told["convention"] in page
    wide = tmp_path / "wide.toml"
    wide.write_text(own.read_text().replace("width = 400", "width = 401"))
    options = ("--same-aspect", *FASTEST, "--against", wide)
    result = run(photos, "--field", field, "--out", out, *QUIET, *options)
    assert result.exit_code == 1
    assert "wide.toml: is for frames of 401 x 300 px" in result.stderr


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        (
            "cameras.txt",
            "1 SIMPLE_PINHOLE 640 480 500 320 240\n",
            "is for 640 x 480 px, but the photographs have 400 x 300; use the calibration of",
        ),
        (
            "cameras.txt",
            "".join(f"{k} SIMPLE_PINHOLE 400 300 390 200 150\n" for k in (1, 2)),
            "holds the cameras '1', '2'; give a file of one camera",
        ),
        (
            "opencv.yml",
            (
                "%YAML:1.0\n---\ndistortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 4\n"
                "   dt: d\n   data: [ 0., 0., 0., 0. ]\n"
            ),
            "has no camera_matrix; add it or use another calibration",
        ),
        (
            "pix4d.cam",
            (
                "Pix4D camera calibration file 0\n"
                "#Focal Length mm assuming a sensor width of 0.3x0.4mm\n"
                "F 0.4\nPx 0.15\nPy 0.2\nK1 0\nK2 0\nK3 0\nT1 0\nT2 0\n"
            ),
            "is not of the shape of 400 x 300 px; use the calibration of this frame size",
        ),
        ("notes.txt", "my camera\n", "; convert it or write the values to a camera.toml"),
    ],
)
def test_errors_about_the_calibration_to_compare_with_do_not_name_flight_toml(
    photos: Path, tmp_path: Path, name: str, text: str, message: str
) -> None:
    """There is no flight.toml whose [camera] could be corrected."""
    other = tmp_path / name
    other.write_text(text)
    result = run(photos, "--field", photos / "field.toml", "--against", other, *QUIET)
    assert result.exit_code == 1
    assert result.stderr.startswith(f"kgcp: error: {other}")
    assert message in result.stderr
    assert "[camera]" not in result.stderr


def test_too_few_photographs_are_one_line(photos: Path, tmp_path: Path) -> None:
    files = [photos / "photo1.png", photos / "photo2.png", photos / "photo10.png"]
    result = run(*files, "--field", photos / "field.toml", "--out", tmp_path, *QUIET)
    assert result.exit_code == 1
    counts = "2 of 3 photographs can be used, and 3 are needed; left out: 1 too_few (photo10.png: "
    assert counts in result.stderr
    assert result.stderr.endswith("; show the whole field, from nearer and sharp\n")
    assert not [*tmp_path.iterdir()]  # nor a journal, which would refuse another field


@pytest.mark.usefixtures("_no_figures")
def test_an_unusable_camera_is_an_error(photos: Path, tmp_path: Path) -> None:
    three = [photos / f"photo{number}.png" for number in (1, 2, 3)]
    result = run(*three, "--field", photos / "field.toml", "--out", tmp_path, *QUIET, *FASTEST)
    assert result.exit_code == 1
    assert result.stderr.startswith(
        f"kgcp: error: {tmp_path / 'camera.toml'}: is unusable: 3 photographs are fewer than 4"
    )
    assert (tmp_path / "camera.toml").exists()


def test_copies_and_damaged_files_do_not_count(photos: Path, tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for name, source in (("a.png", 1), ("b.png", 1), ("c.png", 2)):
        shutil.copy(photos / f"photo{source}.png", folder / name)
    content = (photos / "photo3.png").read_bytes()
    (folder / "d.png").write_bytes(content[: len(content) // 2])
    result = run(folder, "--field", photos / "field.toml", "--out", tmp_path / "out", *QUIET)
    assert result.exit_code == 1
    assert "2 of 4 photographs can be used, and 3 are needed; left out: 1 dup" in result.stderr
    assert "1 duplicate (b.png: of a.png), 1 decode_failed (d.png: " in result.stderr
    assert "; take more photographs, each from another place; copy the files again" in result.stderr
    assert "description" not in result.stderr  # the field's, which is right


def test_too_few_photographs_of_one_size_are_explained_by_their_sizes(
    photos: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for index in (1, 2, 3, 4):
        grey = cv2.imread(str(photos / f"photo{index}.png"), cv2.IMREAD_GRAYSCALE)
        assert grey is not None
        cv2.imwrite(str(folder / f"{index}.png"), grey if index < 3 else np.rot90(grey))
    result = run(folder, "--field", photos / "field.toml", "--out", tmp_path / "out", *QUIET)
    assert result.exit_code == 1
    sizes = "left out: 2 other_size (3.png: 300 x 400 px, 2 of 4 have 400 x 300, which is"
    assert sizes in result.stderr
    assert result.stderr.endswith("of one size, none of them turned or cropped afterwards\n")


def test_two_focal_lengths_are_two_cameras(photos: Path, tmp_path: Path) -> None:
    for index, focal in ((1, 24.0), (2, 35.0)):
        with Image.open(photos / f"photo{index}.png") as image:
            image.save(tmp_path / f"{index}.jpg", quality=98, exif=exif_of(focal))
    field, out = photos / "field.toml", tmp_path / "out"
    result = run(tmp_path, "--field", field, "--out", out, *QUIET)
    assert result.exit_code == 1
    assert "several cameras or focal lengths: 1 by " in result.stderr
    assert "24 mm, 1 by " in result.stderr
    assert result.stderr.count("\n") == 1


def test_a_missing_focal_length_is_no_other_camera(photos: Path, tmp_path: Path) -> None:
    for index, focal in ((1, 24.0), (2, None)):
        exif = Image.Exif()
        exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = "Maker", "M1"
        if focal is not None:
            exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLength] = focal
        with Image.open(photos / f"photo{index}.png") as image:
            image.save(tmp_path / f"{index}.jpg", quality=98, exif=exif)
    field, out = photos / "field.toml", tmp_path / "out"
    result = run(tmp_path, "--field", field, "--out", out, *QUIET)
    assert "2 of 2 photographs can be used, and 3 are needed" in result.stderr


def test_a_field_in_one_row_is_not_enough(photos: Path, tmp_path: Path) -> None:
    """All but one row is out of the frame."""
    folder = tmp_path / "photos"
    folder.mkdir()
    for index in (1, 3, 5):
        grey = cv2.imread(str(photos / f"photo{index}.png"), cv2.IMREAD_GRAYSCALE)
        assert grey is not None
        grey[:, : grey.shape[1] // 2] = 200
        grey[: grey.shape[0] * 2 // 3] = 200
        cv2.imwrite(str(folder / f"{index}.png"), grey)
    result = run(folder, "--field", photos / "field.toml", "--out", tmp_path / "out", *QUIET)
    assert result.exit_code == 1
    assert "0 of 3 photographs can be used" in result.stderr


def test_two_fields_in_each_photograph_are_to_be_covered(photos: Path, tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for index in (1, 2, 3):
        pair = [cv2.imread(str(photos / f"photo{number}.png")) for number in (index, index + 1)]
        cv2.imwrite(
            str(folder / f"{index}.png"), np.hstack([each for each in pair if each is not None])
        )
    result = run(folder, "--field", photos / "field.toml", "--out", tmp_path / "out", *QUIET)
    assert result.exit_code == 1
    assert "; left out: 3 two_fields (1.png" in result.stderr
    assert "; cover all but one field" in result.stderr


@pytest.mark.usefixtures("_no_figures")
def test_results_that_cannot_be_written_cost_no_measurements(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    obstacle = tmp_path / "calibration.html"
    obstacle.mkdir()
    arguments = (photos, "--field", photos / "field.toml", "--out", tmp_path, *QUIET, *SIMPLE)
    failed = run(*arguments)
    assert f"{obstacle}: is a folder" in failed.stderr
    assert failed.exit_code == 1
    obstacle.rmdir()
    for name in ("measure_photo", "measure_photo_again"):
        monkeypatch.setattr(
            f"kgcp.pipeline.calibration.run.{name}", Mock(side_effect=AssertionError)
        )
    assert run(*arguments).exit_code == 0
    assert not list(tmp_path.glob(".*"))


@pytest.mark.usefixtures("_no_figures")
def test_photographs_of_another_size_are_left_out(photos: Path, tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    shutil.copytree(photos, folder)
    grey = cv2.imread(str(folder / "photo1.png"), cv2.IMREAD_GRAYSCALE)
    assert grey is not None
    cv2.imwrite(str(folder / "photo1.png"), np.rot90(grey))
    out = tmp_path / "out"
    options = (*QUIET, *FASTEST, "--json")
    result = run(folder, "--field", folder / "field.toml", "--out", out, *options)
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["not_used"]["photo1.png"] == "other_size"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--field", "grid:5x4:30mm:40mm"), "overlap"),
        (("--field", "field.json"), "is neither a field's file nor a shorthand"),
        (("--field", "grid:5x4:30mm:16mm", "--format", "opf", "--free-aspect"), "fx and fy differ"),
        (("--field", "grid:5x4:30mm:16mm", "--format", "opensfm", "--model", "rational"), "k4"),
    ],
)
def test_what_cannot_be_is_said_before_anything_is_measured(
    photos: Path, tmp_path: Path, arguments: tuple[str, ...], message: str
) -> None:
    result = run(photos, *arguments, "--out", tmp_path / "out", *QUIET)
    assert result.exit_code == 1
    assert message in result.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["field.toml", "field.csv"])
def test_the_field_s_own_files_are_not_overwritten(photos: Path, tmp_path: Path, name: str) -> None:
    described = tmp_path / "field.toml"
    if name == "field.csv":
        described = tmp_path / "panel.toml"
        described.write_text('diameter_m = 0.016\n[points]\nfile = "field.csv"\n')
        places = [(0.03 * (k % 5), 0.03 * (k // 5) + 0.001 * k) for k in range(20)]
        rows = [f"p{k},{x},{y},0.0\n" for k, (x, y) in enumerate(places)]
        (tmp_path / name).write_text("name,x,y,z\n" + "".join(rows))
    else:
        described.write_text(FIELD_TOML)
    result = run(photos, "--field", described, "--out", tmp_path, *QUIET)
    assert result.exit_code == 1
    assert f"{name}: describes the field and would be overwritten; write to" in result.stderr
    assert result.stderr.count("\n") == 1


def test_a_board_without_a_unit_asks_for_it(photos: Path, tmp_path: Path) -> None:
    board = tmp_path / "calibration_target.yaml"
    key = "boofcv.alg.fiducial.calib.ConfigCalibrationTarget"
    grid = "{numRows: 4, numCols: 5, shapeDistance: 3.0, shapeSize: 1.6}"
    board.write_text(f"# BoofCV\n{key}:\n  grid: {grid}\n  type: CIRCLE_GRID\n")
    out = tmp_path / "out"
    result = run(photos, "--field", board, "--out", out, *QUIET)
    assert result.exit_code == 1
    assert "does not state its unit" in result.stderr
    assert "(--unit)" in result.stderr
    files = (photos / "photo1.png", photos / "photo2.png")
    result = run(*files, "--field", board, "--unit", "cm", "--out", out, *QUIET)
    assert "2 of 2 photographs can be used, and 3 are needed; take more, 12" in result.stderr


def test_a_row_too_many_in_the_description_is_one_line(photos: Path, tmp_path: Path) -> None:
    result = run(photos, "--field", "grid:5x5:30mm:16mm", "--out", tmp_path, *QUIET)
    assert result.exit_code == 1
    assert "left out: 5 ambiguous (photo1.png" in result.stderr
    assert (
        "correct the field's columns, rows and marks, or show all of it or a mark" in result.stderr
    )


def test_the_other_polarity_is_one_line_that_says_so(photos: Path, tmp_path: Path) -> None:
    result = run(photos, "--field", "grid:5x4:30mm:16mm:bright", "--out", tmp_path, *QUIET)
    assert result.exit_code == 1
    assert "correct the field's polarity (':bright' for bright discs" in result.stderr


def test_an_empty_folder_is_one_line_without_a_flight(tmp_path: Path) -> None:
    result = run(tmp_path, "--field", "grid:5x4:30mm:16mm", *QUIET)
    assert result.exit_code == 1
    assert "holds no images; put them there or name another folder" in result.stderr
    assert "flight.toml" not in result.stderr


def test_a_place_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    result = run(tmp_path / "none", "--field", "grid:5x4:30mm:16mm", *QUIET)
    assert result.exit_code == 1
    assert "none: is neither an image nor a folder; name one of them" in result.stderr


def test_files_of_a_phone_are_to_be_converted(tmp_path: Path) -> None:
    photo = tmp_path / "1.HEIC"
    photo.write_bytes(b"")
    result = run(photo, "--field", "grid:5x4:30mm:16mm", *QUIET)
    assert result.exit_code == 1
    assert "1.HEIC: kgcp does not read such files of a phone; convert them to" in result.stderr


def test_the_choices_are_those_of_the_library() -> None:
    assert list(PointModel) == list(POINT_MODELS)
    assert list(LensModel) == list(LENSES)
    assert list(Operator) == list(OPERATORS)
    assert list(Response) == list(RESPONSES)
    assert CAMERA_FORMATS == FORMATS
