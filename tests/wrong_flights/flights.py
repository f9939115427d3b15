"""Flights without images: the sample flight, anywhere on Earth, with any mistake in its files.

Measurements come from `truth.csv`: with the camera and the diameters that flight.toml names, be
they wrong, a pose is fitted to where the true camera has put the true circles. This shares no code
with what is tested.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import CAMERA_FROM_PHOTO, opk_from_rotation, rotation_from_opk
from kgcp.georef.local_frame import LocalFrame
from kgcp.io.tables.columns import Row, time_cell
from kgcp.io.tables.detections import DETECTION_COLUMNS
from kgcp.io.tables.parquet import write_table
from tests.systems import share

SAMPLE = Path(__file__).resolve().parents[2] / "sample_flight"
CRS = "EPSG:25832"
_SD_PX, _SD_DISTANCE = 0.02, 1e-4
_CIRCLE = 2.0 * np.pi * np.arange(24) / 24
_NULL_ROW: dict[str, object] = {column.name: None for column in DETECTION_COLUMNS}
CAMERA = {
    "width": 1200,
    "height": 900,
    "fx": 1903.0,
    "fy": 1901.0,
    "cx": 606.2,
    "cy": 446.1,
    "k1": -0.081,
    "k2": 0.064,
    "p1": 0.0003,
    "p2": 0.0005,
}
TARGET = {
    "outer_diameter_m": 0.9,
    "inner_diameter_m": 0.45,
    "code_diameter_m": 0.6428571428571429,
    "dot_diameter_m": 0.1285714285714286,
}


@dataclass(frozen=True)
class Truth:
    """What happened, in the ENU frame over the vehicle's first place."""

    frames: tuple[str, ...]
    frame_s: FloatArray
    visible: FloatArray
    camera_from_plate: FloatArray
    in_camera_m: FloatArray
    vehicle_s: FloatArray
    vehicle_m: FloatArray
    vehicle_deg: FloatArray
    camera_m: FloatArray
    enu_from_camera: FloatArray


def _rows(name: str) -> list[dict[str, str]]:
    with (SAMPLE / name).open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def _numbers(rows: list[dict[str, str]], *names: str) -> FloatArray:
    return np.array([[float(row[name]) for name in names] for row in rows])


def _unix_s(rows: list[dict[str, str]]) -> FloatArray:
    return np.array(
        [np.datetime64(row["time"].rstrip("Z"), "us").astype(np.int64) / 1e6 for row in rows]
    )


@cache
def truth() -> Truth:
    """Read the sample flight."""
    # ten epochs a second are enough: twice as many would take longer to write and to read
    times, vehicle = _rows("frames.csv"), _rows("vehicle.csv")[::2]
    reference, detected = _rows("reference.csv"), _rows("truth.csv")
    position = _numbers(vehicle, "x", "y", "z")
    frame = LocalFrame.at(CRS, position[0])
    camera_m = frame.enu_from_map(_numbers(reference, "x", "y", "z"))
    opk_deg = _numbers(reference, "omega_deg", "phi_deg", "kappa_deg")
    rotation = _numbers(detected, *(f"r{row}{column}" for row in range(3) for column in range(3)))
    return Truth(
        frames=tuple(row["frame"] for row in times),
        frame_s=_unix_s(times),
        visible=_numbers(detected, "present")[:, 0] == 1.0,
        camera_from_plate=rotation.reshape(-1, 3, 3),
        in_camera_m=_numbers(detected, "cx", "cy", "cz"),
        vehicle_s=_unix_s(vehicle),
        vehicle_m=frame.enu_from_map(position),
        vehicle_deg=_numbers(vehicle, "roll_deg", "pitch_deg", "heading_deg"),
        camera_m=camera_m,
        enu_from_camera=frame.grid_rotation(camera_m)
        @ rotation_from_opk(opk_deg)
        @ CAMERA_FROM_PHOTO,
    )


@dataclass(frozen=True)
class Flight:
    """The contents of a flight's files: right, until a mistake replaces something.

    `camera`, `target` and the following are as in flight.toml. Places and angles of `vehicle` and
    `reference` are as in their files: x, y, z and three angles.
    """

    crs: str
    frame_s: FloatArray
    vehicle_s: FloatArray
    vehicle: FloatArray
    reference: FloatArray | None
    origin_lonlat: FloatArray
    frames: tuple[str, ...] = field(default_factory=lambda: truth().frames)
    reference_frames: tuple[str, ...] = field(default_factory=lambda: truth().frames)
    camera: Mapping[str, float] = field(default_factory=lambda: CAMERA)
    target: Mapping[str, float] = field(default_factory=lambda: TARGET)
    lever_arm_m: tuple[float, ...] = (-0.8, 0.15, -1.95)
    mount_deg: float = 0.0
    vehicle_keys: str = ""
    pictures: tuple[Mapping[str, Any], ...] = ()
    altered: tuple[int, ...] = ()

    def write(self, folder: Path) -> None:
        """Write the flight's folder, with the detections that its camera and target give."""
        folder.mkdir(parents=True)
        (folder / "flight.toml").write_text(self._toml(), encoding="utf-8")
        if self.pictures:
            self._write_pictures(folder / "frames")
        else:
            share(SAMPLE / "frames", folder / "frames")
        lines = ["frame,time"]
        lines += [f"{name},{t:.6f}" for name, t in zip(self.frames, self.frame_s, strict=True)]
        (folder / "frames.csv").write_text("\n".join(lines), encoding="utf-8")
        self._write_table(
            folder / "vehicle.csv",
            "time,x,y,z,roll_deg,pitch_deg,heading_deg,sd_x,sd_y,sd_z,sd_roll_deg,sd_pitch_deg,"
            "sd_heading_deg",
            [f"{t:.6f}" for t in self.vehicle_s],
            self.vehicle,
            (0.01, 0.01, 0.018, 0.02, 0.02, 0.05),
        )
        if self.reference is not None:
            self._write_table(
                folder / "reference.csv",
                "frame,x,y,z,omega_deg,phi_deg,kappa_deg,sd_x,sd_y,sd_z,sd_angle_deg",
                self.reference_frames,
                self.reference,
                (0.004, 0.004, 0.004, 0.003),
            )
        rows = [self._detection(index) for index in range(len(self.frames))]
        write_table(folder / "kgcp" / "detections.parquet", DETECTION_COLUMNS, rows, {})

    @staticmethod
    def _write_table(
        path: Path, header: str, first: Sequence[str], values: FloatArray, sds: tuple[float, ...]
    ) -> None:
        tail = ",".join(f"{sd:.9g}" for sd in sds)
        lines = [
            f"{name},{','.join(f'{value:.12g}' for value in row)},{tail}"
            for name, row in zip(first, values, strict=True)
        ]
        path.write_text("\n".join([header, *lines]), encoding="utf-8")

    def _toml(self) -> str:
        camera = "\n".join(f"{key} = {value!r}" for key, value in self.camera.items())
        target = "\n".join(f"{key} = {value!r}" for key, value in self.target.items())
        reference = "" if self.reference is None else '[reference]\nposes = "reference.csv"\n'
        return (
            f'name = "slip"\ncrs = "{self.crs}"\n[camera]\n{camera}\nresponse = "linear"\n'
            f'[[target]]\nname = "A"\n{target}\ncode_deg = [0, 43, 78, 180]\n'
            f'[vehicle]\ntrajectory = "vehicle.csv"\nlever_arm_m = {list(self.lever_arm_m)}\n'
            f"sd_lever_arm_m = [0.003, 0.003, 0.003]\nsd_time_s = 0.001\n"
            f"mount_deg = {self.mount_deg}\n{self.vehicle_keys}\n{reference}"
        )

    def _write_pictures(self, folder: Path) -> None:
        folder.mkdir()
        for name, tags in zip(self.frames, self.pictures, strict=True):
            picture(folder / name, **tags)

    def _detection(self, index: int) -> Row:
        facts = truth()
        row = _NULL_ROW | {
            "frame": self.frames[index],
            "target": "A",
            "shape": "coded",
            "time": time_cell(float(self.frame_s[index])),
            "instance": 0,
            "status": "not_found",
            "reason": "no_candidate",
            "detail": "",
            "candidates": 0,
            "guided": False,
            "scale_used": "",
        }
        if not facts.visible[index]:
            return row
        rotation, translation, pixel = self._measured(index)
        distance = float(np.linalg.norm(translation))
        cov = np.diag([*3 * [(_SD_DISTANCE * distance) ** 2], *3 * [np.radians(0.2) ** 2]])
        w, x, y, z = Rotation.from_matrix(rotation).as_quat(canonical=True, scalar_first=True)
        tx, ty, tz = translation.tolist()
        return row | {
            "status": "measured",
            "reason": "",
            "scale_used": "A",
            "x_px": float(pixel[0]),
            "y_px": float(pixel[1]),
            "sd_x_px": _SD_PX,
            "sd_y_px": _SD_PX,
            "cov_xy_px2": 0.0,
            "distance_m": distance,
            "sd_distance_m": _SD_DISTANCE * distance,
            "tx_m": tx,
            "ty_m": ty,
            "tz_m": tz,
            "qw": float(w),
            "qx": float(x),
            "qy": float(y),
            "qz": float(z),
            "pose_cov": cov.ravel().tolist(),
            "ambiguity": 100.0,
            "score": 0.99,
            "radius_px": 0.45 * 1902.0 / distance,
        }

    def _measured(self, index: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return rotation, translation and centre as this camera and target measure them."""
        facts = truth()
        rotation, translation = facts.camera_from_plate[index], facts.in_camera_m[index]
        rng = np.random.default_rng(index)
        plate = 0.45 * np.column_stack((np.cos(_CIRCLE), np.sin(_CIRCLE), 0.0 * _CIRCLE))
        points = np.vstack((np.zeros(3), plate)) @ rotation.T + translation
        pixels = _project(points, CAMERA)
        pixel = pixels[0] + _SD_PX * 0.2 * rng.standard_normal(2)
        stretch = 1.0 + _SD_DISTANCE * rng.standard_normal()
        if self.camera is not CAMERA:
            rotation, translation = _fitted(plate, pixels[1:], self.camera, rotation)
        scale = self.target["outer_diameter_m"] / TARGET["outer_diameter_m"]
        if index in self.altered:
            stretch *= 1.1
        return rotation, stretch * scale * translation, pixel


def _matrix(camera: Mapping[str, float]) -> tuple[FloatArray, FloatArray]:
    matrix = np.array(
        [[camera["fx"], 0.0, camera["cx"]], [0.0, camera["fy"], camera["cy"]], [0.0, 0.0, 1.0]]
    )
    return matrix, np.array([camera.get(key, 0.0) for key in ("k1", "k2", "p1", "p2")])


def _project(points: FloatArray, camera: Mapping[str, float]) -> FloatArray:
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), *_matrix(camera))
    return np.asarray(pixels[:, 0], dtype=np.float64)


def _fitted(
    plate: FloatArray, pixels: FloatArray, camera: Mapping[str, float], near: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the pose by pixels of the plate's rim; of the two, that nearer to a rotation."""
    _, turns, shifts, _ = cv2.solvePnPGeneric(
        plate, pixels, *_matrix(camera), flags=cv2.SOLVEPNP_IPPE
    )
    poses = [
        (Rotation.from_rotvec(turn[:, 0]).as_matrix(), np.asarray(shift[:, 0], dtype=np.float64))
        for turn, shift in zip(turns, shifts, strict=True)
    ]
    return max(poses, key=lambda pose: float(np.trace(pose[0].T @ near)))


def picture(
    path: Path,
    size: tuple[int, int] = (1200, 900),
    model: str = "",
    focal_mm: float | None = None,
    focal_35_mm: float | None = None,
    lonlat: tuple[float, float] | None = None,
    altitude_m: float | None = None,
) -> None:
    """Write a grey frame with the header of a drone's camera."""
    exif = Image.Exif()
    if model:
        exif[Base.Make], exif[Base.Model] = "DJI", model
    if focal_mm is not None:
        exif.get_ifd(IFD.Exif)[Base.FocalLength] = focal_mm
    if focal_35_mm is not None:
        exif.get_ifd(IFD.Exif)[Base.FocalLengthIn35mmFilm] = round(focal_35_mm)
    if lonlat is not None:
        longitude, latitude = lonlat
        exif.get_ifd(IFD.GPSInfo).update(
            {
                GPS.GPSLatitudeRef: "N" if latitude >= 0 else "S",
                GPS.GPSLatitude: (abs(latitude), 0.0, 0.0),
                GPS.GPSLongitudeRef: "E" if longitude >= 0 else "W",
                GPS.GPSLongitude: (abs(longitude), 0.0, 0.0),
            }
        )
    xmp = b"" if altitude_m is None else b'<a drone-dji:RelativeAltitude="%+.2f"/>' % altitude_m
    Image.new("L", size, 90).save(path, quality=20, exif=exif, xmp=xmp)


def drone_pictures(**changes: object) -> tuple[Mapping[str, Any], ...]:
    """Return the headers of a drone that knows its place and height."""
    heights = _heights_m()
    return tuple(
        {
            "model": "FC300S",
            "focal_mm": 8.8,
            "focal_35_mm": 57.0,
            "lonlat": (11.549, 48.151),
            "altitude_m": float(height),
        }
        | changes
        for height in heights
    )


def with_receiver(one: Flight) -> Flight:
    """Return a flight whose frames have the places of its reference poses in their headers."""
    assert one.reference is not None
    to_wgs84 = Transformer.from_crs(one.crs, "EPSG:4979", always_xy=True)
    x, y, z = one.reference[:, :3].T
    places = np.column_stack(to_wgs84.transform(x, y, z))[:, :2].tolist()
    pictures = one.pictures or drone_pictures()
    located = ({**each, "lonlat": place} for each, place in zip(pictures, places, strict=True))
    return replace(one, pictures=tuple(located))


def _heights_m() -> FloatArray:
    facts = truth()
    return facts.camera_m[:, 2] - 2.0


def flight(
    crs: str = CRS, origin: tuple[float, float, float] = (689591.9, 5336214.0, 545.5)
) -> Flight:
    """Return the flight, without any slip, over a point of a map."""
    facts = truth()
    frame = LocalFrame.at(crs, np.array(origin))
    vehicle = np.column_stack((frame.map_from_enu(facts.vehicle_m), facts.vehicle_deg))
    map_from_enu = np.swapaxes(frame.grid_rotation(facts.camera_m), 1, 2)
    opk = opk_from_rotation(map_from_enu @ facts.enu_from_camera @ CAMERA_FROM_PHOTO)
    reference = np.column_stack((frame.map_from_enu(facts.camera_m), opk))
    return Flight(
        crs=crs,
        frame_s=facts.frame_s,
        vehicle_s=facts.vehicle_s,
        vehicle=vehicle,
        reference=reference,
        origin_lonlat=frame.geodetic_deg(np.zeros((1, 3)))[0, :2],
    )


def changed(values: Mapping[str, float], **changes: float) -> dict[str, float]:
    """Return numbers of flight.toml with some replaced."""
    return {**values, **changes}


def scaled(values: Mapping[str, float], factor: float, *names: str) -> dict[str, float]:
    """Return numbers of flight.toml with some, or all, times a factor."""
    return {
        name: value * factor if not names or name in names else value
        for name, value in values.items()
    }


def without_reference(one: Flight) -> Flight:
    """Return a flight that has no reference poses."""
    return replace(one, reference=None)
