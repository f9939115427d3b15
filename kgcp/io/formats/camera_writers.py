"""A calibrated camera as files of other programs, with their pixels and order of terms.

`kgcp.io.formats.calibrations` has the readers of all of these, with the sources of their
conventions. A model that a format cannot hold is refused by name.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.calibration import CALIBRATION_PARAMETERS
from kgcp.geometry.camera import Camera

_CENTRE_TO_CORNER_PX = 0.5
_RATIONAL = ("k4", "k5", "k6")
_MM_PER_PX = 0.001  # assumed: formats in millimetres need a sensor size, which is not known


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedCamera:
    """A camera and its precision."""

    camera: Camera
    cov: FloatArray  # (12, 12): of `CALIBRATION_PARAMETERS`
    rms_px: float  # per point


def _opencv(calibrated: CalibratedCamera) -> str:
    camera = calibrated.camera
    return "\n".join(
        [
            "%YAML:1.0",
            "---",
            f"image_width: {camera.width}",
            f"image_height: {camera.height}",
            *_opencv_matrix("camera_matrix", _camera_matrix(camera)),
            *_opencv_matrix("distortion_coefficients", np.array([_coefficients(camera)])),
            f"avg_reprojection_error: {calibrated.rms_px!r}",
            f'calibration_covariance_of: "{" ".join(CALIBRATION_PARAMETERS)}"',
            *_opencv_matrix("calibration_covariance", calibrated.cov),
            "",
        ]
    )


def _opencv_matrix(name: str, matrix: FloatArray) -> list[str]:
    rows, columns = matrix.shape
    data = [", ".join(map(_opencv_number, row)) for row in matrix.tolist()]
    return [
        f"{name}: !!opencv-matrix",
        f"   rows: {rows}",
        f"   cols: {columns}",
        "   dt: d",
        "   data: [ " + ",\n       ".join(data) + " ]",
    ]


def _opencv_number(value: float) -> str:
    """Return a number with all its digits and a point, which OpenCV requires."""
    text = repr(value)
    mantissa, mark, exponent = text.partition("e")
    return text if "." in mantissa else f"{mantissa}.0{mark}{exponent}"


def _ros(calibrated: CalibratedCamera) -> str:
    camera = calibrated.camera
    coefficients = _coefficients(camera)
    model = "plumb_bob" if len(coefficients) == 5 else "rational_polynomial"
    projection = np.column_stack((_camera_matrix(camera), np.zeros(3)))
    matrices = (
        ("camera_matrix", _camera_matrix(camera)),
        ("distortion_coefficients", np.array([coefficients])),
        ("rectification_matrix", np.eye(3)),
        ("projection_matrix", projection),
    )
    lines = [
        f"image_width: {camera.width}",
        f"image_height: {camera.height}",
        "camera_name: camera",
        f"distortion_model: {model}",
    ]
    for name, matrix in matrices:
        data = ", ".join(map(_opencv_number, matrix.ravel().tolist()))
        lines += [
            f"{name}:",
            f"  rows: {matrix.shape[0]}",
            f"  cols: {matrix.shape[1]}",
            f"  data: [{data}]",
        ]
    return "\n".join(lines) + "\n"


def _metashape(calibrated: CalibratedCamera) -> str:
    camera = calibrated.camera
    _refuse_rational(camera, "Metashape")
    values = {
        "f": camera.fy,
        "cx": camera.cx + _CENTRE_TO_CORNER_PX - 0.5 * camera.width,
        "cy": camera.cy + _CENTRE_TO_CORNER_PX - 0.5 * camera.height,
        "b1": camera.fx - camera.fy,
        "k1": camera.k1,
        "k2": camera.k2,
        "k3": camera.k3,
        "p1": camera.p2,  # Metashape exchanges the two
        "p2": camera.p1,
    }
    order = ("fy", "cx", "cy", "fx", "k1", "k2", "k3", "p2", "p1")
    indices = [CALIBRATION_PARAMETERS.index(name) for name in order]
    jacobian = np.eye(9)
    jacobian[3, 0] = -1.0  # b1 = fx - fy
    cov = jacobian @ calibrated.cov[np.ix_(indices, indices)] @ jacobian.T
    estimated = [index for index in range(9) if cov[index, index] > 0.0]
    names = [name for index, name in enumerate(values) if index in estimated]
    coefficients = " ".join(map(repr, cov[np.ix_(estimated, estimated)].ravel().tolist()))
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        "<calibration>",
        "  <projection>frame</projection>",
        f"  <width>{camera.width}</width>",
        f"  <height>{camera.height}</height>",
        *(f"  <{name}>{value!r}</{name}>" for name, value in values.items()),
        "  <covariance>",
        f"    <params>{' '.join(names)}</params>",
        f"    <coeffs>{coefficients}</coeffs>",
        "  </covariance>",
        "</calibration>",
    ]
    return "\n".join(lines) + "\n"


def _colmap(calibrated: CalibratedCamera) -> str:
    camera = calibrated.camera
    x, y = camera.cx + _CENTRE_TO_CORNER_PX, camera.cy + _CENTRE_TO_CORNER_PX
    params = [camera.fx, camera.fy, x, y, camera.k1, camera.k2, camera.p1, camera.p2]
    higher_terms = [camera.k3, camera.k4, camera.k5, camera.k6]
    model = "FULL_OPENCV" if any(higher_terms) else "OPENCV"
    numbers = [*params, *(higher_terms if any(higher_terms) else ())]
    return (
        "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"1 {model} {camera.width} {camera.height} {' '.join(map(repr, numbers))}\n"
    )


def _opensfm(calibrated: CalibratedCamera) -> str:
    camera = calibrated.camera
    _refuse_rational(camera, "OpenSfM")
    longer_side = max(camera.width, camera.height)
    model = {
        "projection_type": "brown",
        "width": camera.width,
        "height": camera.height,
        "focal_x": camera.fx / longer_side,
        "focal_y": camera.fy / longer_side,
        "c_x": (camera.cx - 0.5 * (camera.width - 1)) / longer_side,
        "c_y": (camera.cy - 0.5 * (camera.height - 1)) / longer_side,
        **{name: getattr(camera, name) for name in ("k1", "k2", "p1", "p2", "k3")},
    }
    return json.dumps({"all": model}, indent=4) + "\n"


def _pix4d(calibrated: CalibratedCamera) -> str:
    camera = calibrated.camera
    _refuse_rational(camera, "Pix4D")
    _refuse_aspect(camera, "Pix4D")
    width_mm, height_mm = camera.width * _MM_PER_PX, camera.height * _MM_PER_PX
    x, y = camera.cx + _CENTRE_TO_CORNER_PX, camera.cy + _CENTRE_TO_CORNER_PX
    return (
        "Pix4D camera calibration file 0\n"
        f"#Focal Length mm assuming a sensor width of {width_mm!r}x{height_mm!r}mm\n"
        f"F {camera.fx * _MM_PER_PX!r}\n#Principal Point mm\n"
        f"Px {x * _MM_PER_PX!r}\nPy {y * _MM_PER_PX!r}\n"
        "#Symmetrical Lens Distortion Coeffs\n"
        f"K1 {camera.k1!r}\nK2 {camera.k2!r}\nK3 {camera.k3!r}\n"
        f"#Tangential Lens Distortion Coeffs\nT1 {camera.p1!r}\nT2 {camera.p2!r}\n"
    )


def _opf(calibrated: CalibratedCamera) -> str:
    camera = calibrated.camera
    _refuse_rational(camera, "OPF")
    _refuse_aspect(camera, "OPF")
    internals = {
        "type": "perspective",
        "principal_point_px": [
            camera.cx + _CENTRE_TO_CORNER_PX,
            camera.cy + _CENTRE_TO_CORNER_PX,
        ],
        "focal_length_px": camera.fx,
        "radial_distortion": [camera.k1, camera.k2, camera.k3],
        "tangential_distortion": [camera.p1, camera.p2],
    }
    sensor = {
        "id": 1,
        "name": "camera",
        "bands": [{"name": "Grey", "weight": 1.0}],
        "image_size_px": [camera.width, camera.height],
        "internals": internals,
        "pixel_size_um": 1e3 * _MM_PER_PX,
        "shutter_type": "global",
    }
    document = {
        "format": "application/opf-input-cameras+json",
        "version": "1.0",
        "captures": [],
        "sensors": [sensor],
    }
    return json.dumps(document, indent=4) + "\n"


def _mmvii(calibrated: CalibratedCamera) -> str:
    camera = calibrated.camera
    _refuse_rational(camera, "MMVII")
    _refuse_aspect(camera, "MMVII")
    sd = np.sqrt(calibrated.cov.diagonal())
    deviations = ", ".join(
        f"{name} {value:.3g}" for name, value in zip(CALIBRATION_PARAMETERS, sd, strict=True)
    )
    groups = {
        "Radial": {"K1": camera.k1, "K2": camera.k2, "K3": camera.k3},
        "Decentric": {"p1": camera.p2, "p2": camera.p1},  # MMVII exchanges the two
        "Polynomial": {"b1": 0.0, "b2": 0.0},
    }
    terms: list[str] = []
    for group, values in groups.items():
        terms += [f"            <{group}>"]
        terms += [f"               <{name}>{value!r}</{name}>" for name, value in values.items()]
        terms += [f"            </{group}>"]
    lines = [
        '<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>',
        "<Root>",
        '   <Type>"MMVII_Serialization"</Type>',
        '   <Version>"0.0.0"</Version>',
        "   <Data>",
        "      <InternalCalibration>",
        '         <Name>"Calib-PerspCentral-camera"</Name>',
        "         <PixelFrame>",
        f"            <NbPix>{camera.width} {camera.height}</NbPix>",
        "         </PixelFrame>",
        '         <Projection>"Stenope"</Projection>',
        "         <Auxiliary>",
        "            <SzBuffer>-1</SzBuffer>",
        "            <Degree>3 1 1</Degree>",
        "            <DegreeApproxInv>3 1 1</DegreeApproxInv>",
        "            <IsFraserMode>1</IsFraserMode>",
        "         </Auxiliary>",
        "         <PerfectProj>",
        f"            <F>{camera.fy!r}</F>",
        f"            <PP>{camera.cx!r} {camera.cy!r}</PP>",
        "         </PerfectProj>",
        "         <Distorsion>",
        *terms,
        "         </Distorsion>",
        "         <Informations>",
        f'            <el>"kgcp; standard deviations: {deviations}"</el>',
        "         </Informations>",
        "      </InternalCalibration>",
        "   </Data>",
        "</Root>",
    ]
    return "\n".join(lines) + "\n"


_FORMATS: Mapping[str, tuple[str, Callable[[CalibratedCamera], str]]] = {
    "opencv": ("opencv.yml", _opencv),
    "ros": ("camera_info.yaml", _ros),
    "metashape": ("metashape.xml", _metashape),
    "colmap": ("cameras.txt", _colmap),
    "opensfm": ("camera_models_overrides.json", _opensfm),
    "pix4d": ("pix4d.cam", _pix4d),
    "opf": ("opf_sensor.json", _opf),
    "mmvii": ("mmvii_calib.xml", _mmvii),
}

CAMERA_FORMATS = tuple(_FORMATS)
"""Names of the formats."""

ONE_FOCAL_LENGTH = ("pix4d", "opf", "mmvii")
"""Names of the formats that cannot hold different fx and fy."""


def camera_file(calibrated: CalibratedCamera, form: str) -> tuple[str, str]:
    """Return the name and the text of a camera's file.

    Raises
    ------
    KgcpError
        If the format cannot hold the camera's model. The message names the terms.
    """
    name, write = _FORMATS[form]
    return name, write(calibrated)


def not_renewed(folder: Path, written: Collection[Path]) -> tuple[str, ...]:
    """Return the formats whose file is left from an earlier calibration and not written now."""
    paths = {form: folder / name for form, (name, _) in _FORMATS.items()}
    return tuple(form for form, path in paths.items() if path not in written and path.exists())


def _camera_matrix(camera: Camera) -> FloatArray:
    return np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])


def _coefficients(camera: Camera) -> list[float]:
    names = CALIBRATION_PARAMETERS[4:]
    is_rational = any(getattr(camera, name) for name in _RATIONAL)
    return [getattr(camera, name) for name in (names if is_rational else names[:5])]


def _refuse_rational(camera: Camera, program: str) -> None:
    terms = [name for name in _RATIONAL if getattr(camera, name)]
    if terms:
        raise KgcpError(
            f"the camera's {', '.join(terms)} cannot be written for {program}; calibrate"
            " without the rational model, or choose other formats"
        )


def _refuse_aspect(camera: Camera, program: str) -> None:
    if camera.fx != camera.fy:
        raise KgcpError(
            f"the camera's fx and fy differ, but cameras of {program} have one focal length;"
            " calibrate with one, or choose other formats"
        )
