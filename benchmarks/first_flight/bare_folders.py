"""Bare folders: rendered frames and the files of cameras and rovers, without a flight.toml."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from pathlib import Path

import numpy as np
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base
from PIL.TiffImagePlugin import IFDRational

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera
from kgcp.georef.crs import wgs84_from_map
from kgcp.georef.local_frame import LocalFrame
from kgcp.georef.trajectory import Trajectory
from kgcp.io.files.gps_time import WEEK_S
from kgcp.simulation.flight import (
    CRS,
    LEVER_ARM_M,
    ORIGIN_MAP,
    TARGET_PLATE,
    FlightPlan,
    grow_ground,
    plan_flight,
    render_frame,
)
from kgcp.simulation.ground import Ground
from kgcp.simulation.path import CameraState
from kgcp.simulation.presets import preset
from kgcp.simulation.scene import PlatePose, SimulatedScene, render_irradiance

LEVER_ARM = LEVER_ARM_M
"""Lever arm that the surveyor measures on the vehicle [m]."""
STATIC_MAP: FloatArray = ORIGIN_MAP + np.array([20.0, -35.0, 0.6])
"""Position of the static target in `CRS` [m]."""

_GPS_AHEAD_S = 18.0
_GPS_START = datetime(1980, 1, 6, tzinfo=UTC)
_JPEG_QUALITY = 94
_LOCAL = timedelta(hours=2)  # offset of the drone's clock, which states no time zone
_XMP_MARK = b"http://ns.adobe.com/xap/1.0/\0"
_ENU_FROM_LEVEL_PLATE = np.diag([1.0, -1.0, -1.0])  # x east, y south, z down
_POS_COLUMNS = (
    *("latitude(deg)", "longitude(deg)", "height(m)", "Q", "ns", "sdn(m)", "sde(m)", "sdu(m)"),
    *("sdne(m)", "sdeu(m)", "sdun(m)", "age(s)", "ratio"),
)


@dataclass(frozen=True, slots=True)
class DroneCamera:
    """Metadata that a drone writes to its photos."""

    model: str
    has_calibration: bool  # whether photos have DewarpData
    focal_35_mm: int


Render = Callable[[FlightPlan, int], GreyArray]
"""Function that returns the grey values of a frame."""

FACTORY_CALIBRATED = DroneCamera("M3E", has_calibration=True, focal_35_mm=55)
CONSUMER = DroneCamera("FC0000", has_calibration=False, focal_35_mm=55)


def plan(frames: int, seed: int) -> FlightPlan:
    """Return a flight over a driving vehicle; all frames show the target, at 10 to 45 m."""
    settings = replace(
        preset("sample"),
        frames=frames,
        distance_m=(10.0, 45.0),
        absent_share=0.0,
        decoy_share=0.0,
    )
    return plan_flight(settings, seed)


def rendered(flight: FlightPlan, index: int) -> GreyArray:
    """Return a frame with the target on its vehicle."""
    return render_frame(flight, _ground(flight.seed), index)


def rendered_static(flight: FlightPlan, index: int) -> GreyArray:
    """Return a frame with the plate on the ground, without a vehicle."""
    frame, settings = flight.frames[index], flight.settings
    rng = np.random.default_rng([flight.seed, index])
    scene = SimulatedScene(frame.camera.ground, None, (PlatePose(TARGET_PLATE, frame.target),))
    ground = _ground(flight.seed)
    irradiance = render_irradiance(settings.camera, ground, scene, frame.optics, rng)
    return settings.sensor.expose(irradiance, frame.gain, rng)


@lru_cache(maxsize=1)
def _ground(seed: int) -> Ground:
    return grow_ground(seed)


def write_dji_folder(
    folder: Path, flight: FlightPlan, first_number: int = 1, render: Render = rendered
) -> None:
    """Write a folder of a DJI drone with its MRK file and the rover's `.pos`."""
    folder.mkdir(parents=True)
    moments = [datetime.fromtimestamp(time_s, UTC) + _LOCAL for time_s in flight.recorded_times_s]
    names = [
        f"DJI_{moment:%Y%m%d%H%M%S}_{first_number + index:04d}_V.JPG"
        for index, moment in enumerate(moments)
    ]
    _write_frames(folder, flight, names, FACTORY_CALIBRATED, render)
    stem = names[0].rpartition(f"_{first_number:04d}")[0]
    (folder / f"{stem}_Timestamp.MRK").write_text(_marks(flight, first_number), encoding="ascii")
    (folder / "rover.pos").write_text(solution_content(flight.trajectory), encoding="ascii")


def write_sbet_folder(folder: Path, flight: FlightPlan, render: Render = rendered) -> None:
    """Write frames of a machine-vision camera, named by Unix time, its calibration, and an SBET."""
    (folder / "cam0").mkdir(parents=True)
    for index, time_s in enumerate(flight.recorded_times_s.tolist()):
        image = Image.fromarray(render(flight, index))
        image.save(folder / "cam0" / f"{time_s:.6f}.png", "PNG", compress_level=3)
    (folder / "camera.yml").write_text(_opencv(flight.settings.camera), encoding="ascii")
    (folder / "sbet_mission_1.out").write_bytes(sbet_content(flight.trajectory))
    (folder / "smrmsg_mission_1.out").write_bytes(smrmsg_content(flight.trajectory))


def write_static_folder(folder: Path, flight: FlightPlan, render: Render = rendered_static) -> None:
    """Write frames of a consumer drone over a static target on the ground, and no other files."""
    folder.mkdir(parents=True)
    names = [f"DJI_{1 + index:04d}.JPG" for index in range(len(flight.frames))]
    _write_frames(folder, _over_static_target(flight), names, CONSUMER, render)


def _over_static_target(flight: FlightPlan) -> FlightPlan:
    """Return the flight with every camera moved over one place, where the plate lies level."""
    place = LocalFrame.at(CRS, ORIGIN_MAP).enu_from_map(STATIC_MAP[None])[0]
    frames = []
    for frame in flight.frames:
        moved = frame.camera.position_enu_m + place - frame.target_enu_m
        camera = CameraState(frame.camera.enu_from_camera, moved)
        pose = camera.pose_of(_ENU_FROM_LEVEL_PLATE, place)
        frames.append(replace(frame, camera=camera, target=pose, target_enu_m=place))
    return replace(flight, frames=tuple(frames), target_map=np.tile(STATIC_MAP, (len(frames), 1)))


def _write_frames(
    folder: Path,
    flight: FlightPlan,
    names: list[str],
    drone: DroneCamera,
    render: Render,
) -> None:
    places = _camera_places(flight)
    for index, name in enumerate(names):
        buffer = io.BytesIO()
        image = Image.fromarray(render(flight, index))
        exif = _exif(flight, index, drone, places[index])
        image.save(buffer, "JPEG", quality=_JPEG_QUALITY, exif=exif)
        xmp = _xmp(flight.settings.camera, drone, float(places[index, 2] - ORIGIN_MAP[2]))
        (folder / name).write_bytes(with_xmp(buffer.getvalue(), xmp))


def _camera_places(flight: FlightPlan) -> FloatArray:
    """Return longitude, latitude and height (n, 3) of the cameras."""
    frame = LocalFrame.at(CRS, ORIGIN_MAP)
    centres = np.array([each.camera.position_enu_m for each in flight.frames])
    return wgs84_from_map(CRS, list(frame.map_from_enu(centres)), "frames")


def _exif(flight: FlightPlan, index: int, drone: DroneCamera, place: FloatArray) -> bytes:
    moment = datetime.fromtimestamp(float(flight.recorded_times_s[index]), UTC) + _LOCAL
    exif = Image.Exif()
    exif[Base.Make], exif[Base.Model] = "DJI", drone.model
    tags = exif.get_ifd(IFD.Exif)
    tags[Base.ExposureTime] = IFDRational(1, 1250)
    tags[Base.FNumber] = IFDRational(28, 5)
    tags[Base.ISOSpeedRatings] = 100
    tags[Base.FocalLengthIn35mmFilm] = drone.focal_35_mm
    tags[Base.DateTimeOriginal] = moment.strftime("%Y:%m:%d %H:%M:%S")
    gps = exif.get_ifd(IFD.GPSInfo)
    for tag, reference, value in (
        (GPS.GPSLatitude, GPS.GPSLatitudeRef, place[1]),
        (GPS.GPSLongitude, GPS.GPSLongitudeRef, place[0]),
    ):
        gps[reference] = "N" if tag == GPS.GPSLatitude else "E"
        gps[tag] = (IFDRational(round(float(value) * 1e7), 10**7), IFDRational(0), IFDRational(0))
    return exif.tobytes()


def _xmp(camera: Camera, drone: DroneCamera, relative_m: float) -> bytes:
    values = {"RelativeAltitude": f"{relative_m:+.2f}"}
    if drone.has_calibration:
        middle = 0.5 * (camera.width - 1), 0.5 * (camera.height - 1)
        offsets = camera.cx - middle[0], camera.cy - middle[1]
        distortion = camera.k1, camera.k2, camera.p1, camera.p2, camera.k3
        numbers = [camera.fx, camera.fy, *offsets, *distortion]
        shown = ",".join(f"{number:.9f}" for number in numbers)
        values |= {"DewarpData": f"2026-03-02;{shown}", "DewarpFlag": "0"}
    attributes = " ".join(f'drone-dji:{name}="{value}"' for name, value in values.items())
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF'
        ' xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description'
        f' xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" {attributes}/></rdf:RDF></x:xmpmeta>'
    ).encode()


def with_xmp(jpeg: bytes, xmp: bytes) -> bytes:
    """Return a JPEG with an XMP segment added."""
    payload = _XMP_MARK + xmp
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload + jpeg[2:]


def _gps_week(unix_s: float) -> tuple[int, float]:
    """Return GPS week and seconds of the week."""
    since = unix_s + _GPS_AHEAD_S - _GPS_START.timestamp()
    week = int(since // WEEK_S)
    return week, since - week * WEEK_S


def _marks(flight: FlightPlan, first_number: int) -> str:
    places = _camera_places(flight)
    rows = []
    for index, time_s in enumerate(flight.recorded_times_s.tolist()):
        week, seconds = _gps_week(time_s)
        longitude, latitude, height = places[index].tolist()
        rows.append(
            f"{first_number + index}\t{seconds:.6f}\t[{week}]\t     0,N\t     0,E\t   193,V\t"
            f"{latitude:.8f},Lat\t{longitude:.8f},Lon\t{height:.3f},Ellh\t0.012, 0.011, 0.024\t50,Q"
        )
    return "\n".join(rows) + "\n"


def solution_content(trajectory: Trajectory) -> str:
    """Return a trajectory as RTKLIB writes it."""
    rows = [
        "% program   : RTKLIB ver.demo5",
        "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,5:single,ns=# of satellites)",
        f"%  GPST  {' '.join(_POS_COLUMNS)}",
    ]
    places = wgs84_from_map(CRS, list(trajectory.position_map), "rover")
    sds = trajectory.sd_position_m
    assert sds is not None
    times = trajectory.time_s.tolist()
    for time_s, (longitude, latitude, height), (east, north, up) in zip(
        times, places.tolist(), sds.tolist(), strict=True
    ):
        moment = datetime.fromtimestamp(time_s + _GPS_AHEAD_S, UTC)
        rows.append(
            f"{moment:%Y/%m/%d %H:%M:%S.%f} {latitude:.10f} {longitude:.10f} {height:.4f} 1 14"
            f" {north:.4f} {east:.4f} {up:.4f} 0.0000 0.0000 0.0000 0.00 99.9"
        )
    return "\n".join(rows) + "\n"


def sbet_content(trajectory: Trajectory) -> bytes:
    """Return a trajectory as POSPac writes it."""
    places = wgs84_from_map(CRS, list(trajectory.position_map), "sbet")
    records = np.zeros((len(places), 17))
    records[:, 0] = [_gps_week(time_s)[1] for time_s in trajectory.time_s.tolist()]
    records[:, 1:3] = np.radians(places[:, [1, 0]])
    records[:, 3] = places[:, 2]
    records[:, 7:10] = np.radians(trajectory.attitude_deg)
    return records.astype("<f8").tobytes()


def smrmsg_content(trajectory: Trajectory) -> bytes:
    """Return the accuracies of a trajectory as POSPac writes them."""
    assert trajectory.sd_position_m is not None
    assert trajectory.sd_attitude_deg is not None
    records = np.zeros((len(trajectory.time_s), 10))
    records[:, 0] = [_gps_week(time_s)[1] for time_s in trajectory.time_s.tolist()]
    records[:, 1:4] = trajectory.sd_position_m[:, [1, 0, 2]]
    records[:, 7:10] = 60.0 * trajectory.sd_attitude_deg
    return records.astype("<f8").tobytes()


def _opencv(camera: Camera) -> str:
    matrix = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    distortion = [camera.k1, camera.k2, camera.p1, camera.p2, camera.k3]
    return "\n".join(
        (
            "%YAML:1.0",
            "---",
            f"image_width: {camera.width}",
            f"image_height: {camera.height}",
            *_opencv_matrix("camera_matrix", 3, 3, matrix),
            *_opencv_matrix("distortion_coefficients", 1, 5, distortion),
            "",
        )
    )


def _opencv_matrix(name: str, rows: int, columns: int, data: list[float]) -> Iterator[str]:
    yield f"{name}: !!opencv-matrix"
    yield from (f"   rows: {rows}", f"   cols: {columns}", "   dt: d", f"   data: {data}")
