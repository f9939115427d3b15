"""Static targets placed from all oriented frames of a flight, and the files of the result."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.attitude import ReferencePoses
from kgcp.georef.crs import is_geographic
from kgcp.georef.gcp import Gcp, build_gcps
from kgcp.georef.local_frame import LocalFrame
from kgcp.georef.scene_rotation import CameraMotions
from kgcp.georef.sighting import Sighting, known_times_s
from kgcp.georef.target_positions import TargetPosition, TargetPositions
from kgcp.io.exporters.points import MapPoints
from kgcp.io.files.atomic import write_all
from kgcp.io.files.safe_read import is_missing, is_no_file
from kgcp.io.flight.data import FlightData
from kgcp.io.flight.flight import Flight
from kgcp.io.formats.orientations import read_reference_poses
from kgcp.io.tables.columns import row_of
from kgcp.io.tables.detections import read_attempts
from kgcp.io.tables.parquet import write_table
from kgcp.io.tables.places import (
    PLACE_COLUMNS,
    PLACE_RESIDUAL_COLUMNS,
    places_csv,
    residual_rows,
)
from kgcp.io.tables.provenance import derived_provenance
from kgcp.network.ground.target_places import PlacedTarget, Placement, TargetMove, place_targets
from kgcp.network.ground.target_plane import MAX_EXTRA_PX
from kgcp.pipeline.execution.threads import single_threaded
from kgcp.pipeline.export import write_formats
from kgcp.pipeline.flight_inputs import outdated_poses
from kgcp.pipeline.frame_priors import motions_while_read
from kgcp.pipeline.workspace import DETECTIONS, results_folder
from kgcp.quality.place_sentences import (
    common_diameter_sentence,
    contradictions,
    diameter_sentence,
    doubts_of,
    motion_sentence,
    noise_sentence,
    position_sentence,
    step_sentence,
)
from kgcp.report.places.figures import draw_places
from kgcp.report.places.page import PlacesPage, render_places
from kgcp.targets.plain import AnyTarget

EXPORTS = "places"
"""Folder of the files for other packages, in the folder of the results."""

MIN_FRAMES = 3
"""Default least number of frames: two place a circle, the third checks it."""


@dataclass(frozen=True, slots=True)
class PlaceOptions:
    """Options of a placement.

    Attributes
    ----------
    targets : tuple of str
        Names of the targets to place; empty: all with a position in flight.toml.
    poses : Path or None
        File of the camera's poses; None: [reference] of flight.toml.
    min_frames : int
        Least number of frames that show a target.
    has_exact_poses : bool
        Whether the standard deviations of the poses are ignored.
    """

    targets: tuple[str, ...] = ()
    poses: Path | None = None
    min_frames: int = MIN_FRAMES
    has_exact_poses: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class FlightPlaces:
    """Placed targets of a flight.

    Attributes
    ----------
    flight : Flight
    placement : Placement
    sightings : tuple of Sighting
        Sightings that took part.
    local_frame : LocalFrame
        Local frame of the places.
    provenance : mapping of str
        The metadata of the tables.
    motions : CameraMotions or None
        Motions of the camera if it has a rolling shutter.
    doubts_of_poses : tuple of str
        Doubts about the file of the poses.
    """

    flight: Flight
    placement: Placement
    sightings: tuple[Sighting, ...]
    local_frame: LocalFrame
    provenance: Mapping[str, str]
    motions: CameraMotions | None = None
    doubts_of_poses: tuple[str, ...] = ()

    @property
    def sentences(self) -> tuple[str, ...]:
        """Comparison of diameters and places with flight.toml, in words."""
        sentences = []
        for placed in self.placement.targets:
            sentences += [diameter_sentence(placed), position_sentence(placed)]
        return tuple(sentences)

    @property
    def doubts(self) -> tuple[str, ...]:
        """Warnings to consider before the places are used."""
        placed_targets = self.placement.targets
        doubts = [
            doubt
            for placed in placed_targets
            for doubt in (*contradictions(placed), *doubts_of(placed))
        ]
        of_all = (
            common_diameter_sentence(placed_targets),
            step_sentence(self.placement),
            noise_sentence(self.placement),
            motion_sentence(self.motions, self.flight.camera),
        )
        return (*self.doubts_of_poses, *doubts, *(sentence for sentence in of_all if sentence))

    def gcps(self) -> tuple[Gcp, ...]:
        """Return a ground control point at the placed target for every sighting that took part."""
        positions = TargetPositions(
            self.local_frame,
            {placed.target: self._in_enu(placed) for placed in self.placement.targets},
            None,
        )
        gcps, _ = build_gcps(self.sightings, positions, self.flight.camera)
        return gcps

    def _in_enu(self, placed: PlacedTarget) -> TargetPosition:
        position = self.local_frame.enu_from_map(placed.position_map[None])[0]
        axes = self.local_frame.grid_rotation(position)
        return TargetPosition(position, axes @ placed.total_cov[:3, :3] @ axes.T)

    def summary(self) -> dict[str, object]:
        """Return all numbers for machines."""
        noise = self.placement.noise
        return {
            "targets": [_numbers(placed) for placed in self.placement.targets],
            "skipped": dict(self.placement.skipped),
            "extra_noise_px": {"centre": noise.centre_px, "outline": noise.outline_px},
            "sentences": self.sentences,
            "doubts": self.doubts,
        }


@single_threaded()
def place_flight(
    flight: Flight,
    detections: Path | str | None = None,
    options: PlaceOptions = PlaceOptions(),
) -> FlightPlaces:
    """Place the static targets of a flight.

    Parameters
    ----------
    detections : Path, optional
        What `detect_flight` wrote; by default in the flight's results folder.
    options : PlaceOptions
        What to place, and by which poses.

    Raises
    ------
    KgcpError
        If there is no static target, no pose, no crs, a target's name is unknown, a file is
        unreadable, or no target can be placed.
    """
    table = results_folder(flight.folder) / DETECTIONS if detections is None else Path(detections)
    targets = _targets(flight, options.targets)
    attempts = read_attempts(table, flight)
    data = FlightData(flight, sorted({attempt.frame for attempt in attempts}))
    poses = _poses(flight, data, options.poses, [attempt.frame for attempt in attempts])
    local_frame = _local_frame(flight, poses)
    sightings = [attempt.sighting for attempt in attempts if attempt.sighting is not None]
    times_s = known_times_s(attempts)
    motions = motions_while_read(flight, data, poses, local_frame, times_s, sightings)
    with np.errstate(all="ignore"):  # trial circles may be absurd; what is not finite is rejected
        placement = place_targets(
            sightings,
            targets,
            poses,
            local_frame,
            flight.camera,
            flight.calibration_covariance,
            min_frames=options.min_frames,
            has_exact_poses=options.has_exact_poses,
            motions=motions,
        )
    _require_fit(placement, flight, options.poses)
    choices = {
        "targets": options.targets,
        "min_frames": options.min_frames,
        "exact_poses": options.has_exact_poses,
    }
    provenance = derived_provenance(
        flight, table, choices, has_reference=options.poses is None and data.has_reference
    )
    used = _used_sightings(placement, sightings)
    reference = flight.reference
    file = options.poses or (None if reference is None else reference.file)
    doubts = () if file is None else tuple(map(str, outdated_poses(file, flight)))
    return FlightPlaces(flight, placement, used, local_frame, provenance, motions, doubts)


def _require_fit(placement: Placement, flight: Flight, poses: Path | None) -> None:
    """Refuse a placement without targets, or with poses that do not belong to the images."""
    source, option = poses or flight.folder / "flight.toml", None if poses is None else "poses"
    if not placement.targets:
        name, reason = next(iter(placement.skipped.items()))
        raise KgcpError(
            f"{source}: no target can be placed ({name!r}: {reason}); check that enough frames"
            " show the targets and have a pose, and that the poses have the axes and angles that"
            " are stated",
            option=option,
        )
    if placement.noise.centre_px >= MAX_EXTRA_PX:
        raise KgcpError(
            f"{source}: the poses do not fit the images, by"
            f" {MAX_EXTRA_PX:.0f} px or more; look whether angles are of the stated kind, and"
            " whether each pose has its own frame's name",
            option=option,
        )


def _used_sightings(placement: Placement, sightings: Sequence[Sighting]) -> tuple[Sighting, ...]:
    used = {
        (placed.target, frame)
        for placed in placement.targets
        for frame, is_used in zip(placed.frames, placed.is_used, strict=True)
        if is_used
    }
    return tuple(each for each in sightings if (each.target, each.frame) in used)


def write_places(
    places: FlightPlaces, folder: Path, formats: Sequence[str] = ()
) -> tuple[Path, ...]:
    """Write tables, page and the files of some formats; return their paths.

    Raises
    ------
    KgcpError
        If a format is unknown or cannot hold the points, or a file cannot be written.
    """
    placed = places.placement.targets
    flight = places.flight
    tables = (folder / "places.parquet", folder / "place_residuals.parquet")
    crs, names = places.local_frame.crs, ("places.csv", "places.json", "places.html")
    page = PlacesPage(
        flight.name,
        crs,
        places.placement,
        places.doubts,
        draw_places(placed),
        [*(path.name for path in tables), *names],
    )
    text = json.dumps(places.summary(), indent=1, allow_nan=False)
    csv = places_csv(placed, is_geographic=is_geographic(crs))
    texts = dict(zip(names, (csv, f"{text}\n", render_places(page)), strict=True))
    rows = (row_of(PLACE_COLUMNS, target) for target in placed)
    about = {**places.provenance, "crs": crs}
    write_table(tables[0], PLACE_COLUMNS, rows, about)
    write_table(tables[1], PLACE_RESIDUAL_COLUMNS, residual_rows(placed), about)
    write_all({folder / name: text.encode() for name, text in texts.items()})
    written = [*tables, *(folder / name for name in names)]
    if formats:
        points = MapPoints(crs, places.gcps(), flight.camera)
        written += write_formats(points, formats, folder / EXPORTS)
    return tuple(written)


def _targets(flight: Flight, names: Sequence[str]) -> list[AnyTarget]:
    known = {target.name: target for target in flight.all_targets}
    unknown = [name for name in names if name not in known]
    if unknown:
        raise KgcpError(
            f"target {unknown[0]!r}: is not in flight.toml; name one of {', '.join(known)}",
            option="targets",
        )
    if names:
        return [known[name] for name in dict.fromkeys(names)]
    static = list(flight.static_targets)
    if not static:
        raise KgcpError(
            f"{flight.folder / 'flight.toml'}: no target is static; give position_m to those"
            " that are (a rough one is enough), or name the targets to place",
            option="targets",
        )
    return static


def _poses(
    flight: Flight, data: FlightData, file: Path | None, frames: Sequence[str]
) -> ReferencePoses:
    if file is None:
        return data.reference_poses
    if is_no_file(file):
        problem = "does not exist" if is_missing(file) else "is no file"
        raise KgcpError(f"{file}: {problem}; name a file of poses", option="poses")
    return read_reference_poses(file, crs=flight.crs, frames=sorted(set(frames)))


def _local_frame(flight: Flight, poses: ReferencePoses) -> LocalFrame:
    if flight.crs is None:
        raise KgcpError(
            f"{flight.folder / 'flight.toml'}: has no crs; name that of the coordinates,"
            ' for example crs = "EPSG:25831"'
        )
    return LocalFrame.at(flight.crs, poses.position_map[0])


def _numbers(placed: PlacedTarget) -> dict[str, object]:
    check = placed.check
    residual = None if check.residual_m is None else check.residual_m.tolist()
    cov = check.cov_m2
    return {
        "target": placed.target,
        "position": placed.position_map.tolist(),
        "sd_position_m": placed.sds[:3].tolist(),
        "normal": placed.normal.tolist(),
        "sd_normal_deg": placed.sd_normal_deg,
        "tilt_deg": placed.tilt_deg,
        "ambiguity": placed.ambiguity,
        "diameter_m": placed.diameter_m,
        "sd_diameter_m": placed.sd_diameter_m,
        "frames": len(placed.frames),
        "frames_used": int(np.count_nonzero(placed.is_used)),
        "rejected": [
            frame for frame, used in zip(placed.frames, placed.is_used, strict=True) if not used
        ],
        "moved": _split_numbers(placed.move),
        "poses_step": _split_numbers(placed.step),
        "variance_factor": placed.variance_factor,
        "residual_m": residual,
        "sd_residual_m": None if cov is None else np.sqrt(np.diag(cov)).tolist(),
        "diameter_residual_permille": check.diameter_permille,
        "sd_diameter_residual_permille": 1e3
        * check.sd_diameter_residual_m
        / check.stated_diameter_m,
    }


def _split_numbers(move: TargetMove | None) -> dict[str, object] | None:
    return None if move is None else {"frame": move.frame, "distance_m": move.distance_m}
