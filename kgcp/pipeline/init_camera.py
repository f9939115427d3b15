"""The camera of a folder of frames: a calibration, DJI's DewarpData, or a guess from EXIF."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from kgcp.errors import KgcpError
from kgcp.geometry.camera import Camera
from kgcp.io.flight.camera_table import read_camera_file
from kgcp.io.flight.folder import FolderContents
from kgcp.io.flight.toml_draft import DraftKey
from kgcp.io.formats.calibrations import OF_FLIGHT, read_calibration
from kgcp.pipeline.init_records import Gap, InitFinding, Section
from kgcp.quality.checks.frame_header import FrameHeader

_SMALL_FRAME_MM = math.hypot(
    36.0, 24.0
)  # diagonal of 35 mm film, to which CIPA's equivalent focal lengths refer
# Frames whose ratio of width to height is above the first number are assumed to be cropped from a
# sensor whose ratio of height to width is the second number.
_WIDE_ASPECT, _FULL_SHAPE = 1.7, 0.75
_PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_DIGITS = 9
# Standard deviations of a guess. EXIF states equivalent focal lengths in whole millimetres, and the
# focal length of a real lens differs from its nominal value by a few per cent. The values for
# principal point and distortion are typical of consumer cameras.
_SD_FOCAL, _SD_CENTRE, _SD_K1 = 0.03, 0.01, 0.1
_SD_FACTORY = 0.001  # of a focal length calibrated by the manufacturer; see docs/calibrations.md
_REMEDY = (
    "put a calibration file into the folder before kgcp init, or write its values, or file = …,"
    " into [camera]"
)
_WORDS = replace(OF_FLIGHT, other_size="but the frames have")
_SHUTTER = DraftKey("readout_s", None, "rolling shutter: time from first to last row", "0.03")
_RESPONSE = DraftKey("response", None, 'or "srgb": how grey values follow light', '"linear"')


def camera_section(contents: FolderContents, headers: Sequence[FrameHeader]) -> Section:
    """Return the [camera] table for frames, from the best source that is available."""
    sizes = Counter(header.size_px for header in headers if header.size_px is not None)
    if not sizes:
        return _no_camera(None, "the headers of the frames do not state their size")
    size = max(sizes, key=lambda each: (sizes[each], each))
    first = next(header for header in headers if header.size_px == size)
    section = _by_file(contents, first, size)
    if section is not None:
        return section
    section = (
        _by_dewarp_data(contents, first, size)
        or _by_focal_length(headers, size)
        or _no_camera(size, "neither EXIF nor a file of the folder states the focal length")
    )
    return replace(section, gaps=(*section.gaps, *_unfit_files(contents, first, size)))


def _by_file(
    contents: FolderContents, header: FrameHeader, size: tuple[int, int]
) -> Section | None:
    """Return the section by the first calibration file that is for such frames of this size.

    A camera.toml of kgcp comes first: it has a covariance.
    """
    for path in sorted(contents.calibrations, key=lambda each: not _is_camera_toml(each)):
        try:
            camera = _read(path, header, size)
        except KgcpError:  # of another size or camera, or of several cameras
            continue
        name = contents.relative(path)
        keys = (
            DraftKey("file", name, _shown(camera)),
            *(() if _has_size(path) else _size_keys(size)),
            _RESPONSE,
            _SHUTTER,
        )
        others = [contents.relative(other) for other in contents.calibrations if other != path]
        beside = f" (not used: {', '.join(others)})" if others else ""
        found = InitFinding("camera", f"{_shown(camera)}, from {name}{beside}")
        return Section.of("[camera]", (*keys, found))
    return None


def _unfit_files(
    contents: FolderContents, header: FrameHeader, size: tuple[int, int]
) -> Iterator[Gap]:
    """Yield why each calibration file of the folder is not used."""
    for path in contents.calibrations:
        try:
            _read(path, header, size)
        except KgcpError as error:
            problem, _, remedy = str(error).removeprefix(f"{path}: ").partition("; ")
            yield Gap("camera", f"{contents.relative(path)} is not used: it {problem}", remedy)


def _is_camera_toml(path: Path) -> bool:
    return path.suffix == ".toml"


def _read(path: Path, header: FrameHeader, size: tuple[int, int]) -> Camera:
    """Return the camera of a file, if it is one of such frames of this size."""
    if not _is_camera_toml(path):
        return read_calibration(path, size, words=_WORDS)
    stated = read_camera_file(path)
    camera = stated.camera
    if (camera.width, camera.height) != size:
        raise KgcpError(
            f"{path}: is for {camera.width} x {camera.height} px, {_WORDS.other_size} {size[0]} x"
            f" {size[1]}; use the calibration of this frame size"
        )
    own, other = stated.by_exif.difference(header.exif_camera)
    if own:
        raise KgcpError(
            f"{path}: is for {own}, but the frames are by {other}; use the calibration of this"
            " camera and zoom"
        )
    return camera


def _has_size(path: Path) -> bool:
    if _is_camera_toml(path):
        return True
    try:
        read_calibration(path, (None, None))
    except KgcpError:
        return False
    return True


def _by_dewarp_data(
    contents: FolderContents, header: FrameHeader, size: tuple[int, int]
) -> Section | None:
    try:
        camera = read_calibration(contents.frames_folder / header.frame, size, "dji")
    except KgcpError:  # no DewarpData, or of an image that is dewarped already
        return None
    text = f"{_shown(camera)}, from the DewarpData of {header.frame}"
    found = InitFinding("camera", _named(header, text))
    note = f"DJI's calibration of this camera: the DewarpData of {header.frame}."
    sd_px = round(_SD_FACTORY * camera.mean_focal_px, 1)
    keys = (
        *_size_keys(size),
        *_parameter_keys(camera),
        DraftKey("sd_fx", sd_px, "ASSUMED: 1 in 1000, as usual for factory calibrations"),
        DraftKey("sd_fy", sd_px),
        _RESPONSE,
        _SHUTTER,
    )
    gap = Gap(
        "camera",
        "the factory's calibration is good to 1 in 1000 of the focal length",
        "correct sd_fx and sd_fy in [camera], or use a calibration of this flight",
        is_assumed=True,
    )
    return Section.of("[camera]", (*keys, found, gap), note)


def _by_focal_length(headers: Sequence[FrameHeader], size: tuple[int, int]) -> Section | None:
    """Return the section by a guess from EXIF, with its standard deviations."""
    guesses = (_guessed_px(header) for header in headers if header.size_px == size)
    guess = next((guess for guess in guesses if guess is not None), None)
    if guess is None:
        return None
    width, height = size
    header, focal_px, source = guess
    camera = Camera(width, height, focal_px, focal_px, 0.5 * (width - 1), 0.5 * (height - 1))
    sd_px = round(_SD_FOCAL * focal_px, 1)
    centre_px = round(_SD_CENTRE * width, 1)
    keys = (
        DraftKey("guessed", value=True, comment="delete this line once a calibration is given"),
        *_size_keys(size),
        *_parameter_keys(camera),
        DraftKey("sd_fx", sd_px, "standard deviation of the guess"),
        *(DraftKey(f"sd_{key}", sd) for key, sd in (("fy", sd_px), ("cx", centre_px))),
        *(DraftKey(f"sd_{key}", sd) for key, sd in (("cy", centre_px), ("k1", _SD_K1))),
        _RESPONSE,
        _SHUTTER,
    )
    found = InitFinding("camera", _named(header, f"{_shown(camera)}, guessed from the {source}"))
    gap = Gap(
        "camera",
        "the focal length of EXIF, without distortion; a calibration is needed for distances better"
        " than some per cent",
        f"{_REMEDY}, and delete guessed and the sd_ lines",
        is_assumed=True,
    )
    note = f"GUESS from the {source}. A calibration is needed for true distances."
    return Section.of("[camera]", (*keys, found, gap), note)


def _guessed_px(header: FrameHeader) -> tuple[FrameHeader, float, str] | None:
    """Return the header, the focal length that it states [px], and the source in words."""
    if header.size_px is None:
        return None
    where = f"EXIF of {header.frame}"
    if header.focal_35_mm is not None:
        focal_px = header.focal_35_mm / _SMALL_FRAME_MM * _full_diagonal_px(*header.size_px)
        source = f"{where}: equivalent to {header.focal_35_mm:g} mm on 35 mm film"
        return header, round(focal_px, 1), source
    if header.focal_px is not None:
        source = f"{where}: {header.focal_mm:g} mm and the sensor's resolution"
        return header, round(header.focal_px, 1), source
    return None


def _full_diagonal_px(width: int, height: int) -> float:
    """Return the diagonal of the sensor, to which equivalent focal lengths refer.

    Frames of 16:9 are cropped from sensors of 4:3. With the diagonal of the frame itself, the focal
    length of the Phantom 3's camera (20 mm, 4000 x 2250 px) would be 8 % too short.
    """
    long, short = max(width, height), min(width, height)
    return math.hypot(long, _FULL_SHAPE * long if long > _WIDE_ASPECT * short else short)


def _no_camera(size: tuple[int, int] | None, why: str) -> Section:
    lengths = (("fx", "2900.0"), ("fy", "2900.0"), ("cx", "1023.5"), ("cy", "1023.5"))
    keys = (
        *(_size_keys(size) if size else _unknown(("width", "2048"), ("height", "2048"))),
        *_unknown(*lengths),
        _RESPONSE,
        _SHUTTER,
    )
    found = (InitFinding("camera", f"{size[0]} x {size[1]} px"),) if size else ()
    parts = (*keys, *found, Gap("camera", why, _REMEDY))
    return Section.of("[camera]", parts, 'Or: file = "camera.yml"')


def _unknown(*examples: tuple[str, str]) -> tuple[DraftKey, ...]:
    return tuple(
        DraftKey(key, None, "from a calibration [px]", example, is_missing=True)
        for key, example in examples
    )


def _size_keys(size: tuple[int, int]) -> tuple[DraftKey, DraftKey]:
    return DraftKey("width", size[0]), DraftKey("height", size[1])


def _parameter_keys(camera: Camera) -> tuple[DraftKey, ...]:
    """Return keys for the parameters that are not zero, and for the four that are required."""
    values = {key: float(f"{getattr(camera, key):.{_DIGITS}g}") for key in _PARAMETERS}
    kept = {key: value for key, value in values.items() if value or key in _PARAMETERS[:4]}
    return tuple(DraftKey(key, value) for key, value in kept.items())


def _named(header: FrameHeader, text: str) -> str:
    return f"{header.camera}: {text}" if header.camera else text


def _shown(camera: Camera) -> str:
    return f"{camera.width} x {camera.height} px, fx = {camera.fx:.6g} px"
