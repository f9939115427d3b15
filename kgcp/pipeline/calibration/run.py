"""Calibration of a camera from photographs of a field: the use case behind `kgcp calibrate`."""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeAlias, TypeVar

import numpy as np

from kgcp.errors import KgcpError, KgcpWarning, Reason
from kgcp.geometry.camera import Response
from kgcp.io.files.safe_read import is_file, is_folder
from kgcp.io.images.frames import FRAME_SUFFIXES, kind_of, list_frames
from kgcp.io.images.remote import stamps_of
from kgcp.io.tables.provenance import versions
from kgcp.measurement.discs.camera_tone import CameraTone
from kgcp.measurement.discs.records import Operator
from kgcp.measurement.exif_camera import ExifCamera
from kgcp.measurement.field_photograph import PhotoDiscs, PhotoMiss, PhotoTask
from kgcp.network.calibration import LEAST_VIEWS, calibrate_camera, missing_discs
from kgcp.network.calibration_records import (
    CalibrationSettings,
    CameraCalibration,
    LensModel,
    NamedView,
    PointModel,
)
from kgcp.pipeline.calibration.photographs import (
    Photo,
    SecondLook,
    learn_from_photos,
    measure_photo,
    measure_photo_again,
)
from kgcp.pipeline.detection_run import ProgressListener
from kgcp.pipeline.execution.executor import WorkerPool, open_pool
from kgcp.pipeline.execution.journal import Journal, fingerprint
from kgcp.pipeline.execution.resilient_map import TaskFailure
from kgcp.pipeline.execution.threads import single_threaded
from kgcp.targets.fields.naming import NamingProblem
from kgcp.targets.fields.points import AnyField

_LOSSES = {TaskFailure.CRASHED: Reason.WORKER_DIED, TaskFailure.TIMED_OUT: Reason.TIMED_OUT}
LEARNED_FROM = 5  # photographs from which the camera's tone curve and processing are learned
# Time limit for one look at a photograph, and for learning the camera from five [s]. The longest
# learning that was seen took 310 s, and the speed of the machine must not decide on results.
_CALL_LIMIT_S = 1800.0
_DIGITS = re.compile(r"(\d+)")

OTHER_SIZE = "other_size"
UNLIKE_FIELD = "unlike_field"
DUPLICATE = "duplicate"
REASONS: Mapping[str, str] = {
    Reason.DECODE_FAILED.value: Reason.DECODE_FAILED.description,
    Reason.WORKER_DIED.value: Reason.WORKER_DIED.description,
    Reason.TIMED_OUT.value: Reason.TIMED_OUT.description,
    "too_few": "fewer than six discs like the field's",
    "no_lattice": "the discs do not lie like the field's",
    "two_fields": "two fields in one photograph",
    "ambiguous": "a part of the field that could be another part; show all of it, or a mark",
    OTHER_SIZE: "the photograph has another size than those that are used",
    DUPLICATE: "the same as another photograph, which says nothing new",
    UNLIKE_FIELD: "it does not fit the camera and the field of the other photographs: other zoom,"
    " focus or crop, a field bent otherwise, or discs with wrong names",
}
"""Why a photograph is not used: the words of the `reason` column."""

_REMEDIES: Mapping[str, str] = {
    Reason.DECODE_FAILED.value: Reason.DECODE_FAILED.remedy,
    Reason.WORKER_DIED.value: Reason.WORKER_DIED.remedy,
    Reason.TIMED_OUT.value: "look at the files that take so long",
    NamingProblem.TOO_FEW.value: "show the whole field, from nearer and sharp",
    NamingProblem.NO_LATTICE.value: "correct the description of the field",
    NamingProblem.TWO_FIELDS.value: (
        "cover all but one field in each photograph; cropped ones cannot be used"
    ),
    NamingProblem.AMBIGUOUS.value: (
        "correct the field's columns, rows and marks, or show all of it or a mark; mirrored"
        " photographs cannot be used"
    ),
    OTHER_SIZE: "give photographs of one size, none of them turned or cropped afterwards",
    DUPLICATE: "take more photographs, each from another place",
}
_NONE_FOUND_REMEDY = (
    "correct the field's polarity (':bright' for bright discs on dark ground), or come nearer"
)

_Item = TypeVar("_Item", Photo, SecondLook)
_Kept: TypeAlias = PhotoDiscs | PhotoMiss | CameraTone  # what a journal keeps


@dataclass(frozen=True, slots=True)
class CalibrationOptions:
    """Options of a calibration.

    Attributes
    ----------
    settings : CalibrationSettings
        The unknowns.
    response : Response
        Response of the camera.
    operator : Operator
        Method of measuring discs.
    jobs : int or None
        Number of worker processes; 0: this process; None: the number of cores.
    is_restart : bool
        Whether to start over instead of resuming an interrupted run.
    """

    settings: CalibrationSettings
    response: Response = Response.UNKNOWN
    operator: Operator = Operator.MODEL
    jobs: int | None = None
    is_restart: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class PhotoCalibration:
    """A calibrated camera, with the result of every photograph."""

    field: AnyField
    options: CalibrationOptions
    calibration: CameraCalibration
    discs: Mapping[str, PhotoDiscs]  # of the photographs that took part
    misses: tuple[PhotoMiss, ...]  # the others
    photos: tuple[str, ...]  # all, in order
    exif_camera: ExifCamera  # of the photographs that took part


def find_photos(places: Sequence[Path]) -> list[Photo]:
    """Return the photographs that files and folders name, in the order of their names.

    Raises
    ------
    KgcpError
        If a place does not exist, holds no photographs, or two have one name.
    """
    photos: list[Photo] = []
    for place in places:
        if is_folder(place):
            names = list_frames(place, "name another folder")
            prefix = f"{place.name}/" if len(places) > 1 else ""
            photos += [Photo(f"{prefix}{name}", place / name) for name in names]
        elif is_file(place) and place.suffix.lower() in FRAME_SUFFIXES:
            photos.append(Photo(place.name, place))
        elif is_file(place):
            kind, conversion = kind_of(place.suffix.lower())
            raise KgcpError(f"{place}: kgcp does not read such {kind}; {conversion}")
        else:
            raise KgcpError(f"{place}: is neither an image nor a folder; name one of them")
    counts = Counter(photo.name for photo in photos)
    twice = [name for name, count in counts.items() if count > 1]
    if twice:
        raise KgcpError(f"{twice[0]}: two photographs have this name; name their folder instead")
    return sorted(photos, key=lambda photo: _in_reading_order(photo.name))


def _in_reading_order(name: str) -> list[tuple[int, str]]:
    """Return a sort key that puts 2.png before 10.png."""
    parts = _DIGITS.split(name)
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]


def calibrate_photos(
    photos: Sequence[Photo],
    field: AnyField,
    out: Path,
    options: CalibrationOptions,
    listener: ProgressListener,
) -> PhotoCalibration:
    """Calibrate the camera that took photographs of a field, without writing results.

    Raises
    ------
    KgcpError
        As `calibrated_photos`.
    """
    with calibrated_photos(photos, field, out, options, listener) as made:
        return made


@contextmanager
def calibrated_photos(
    photos: Sequence[Photo],
    field: AnyField,
    out: Path,
    options: CalibrationOptions,
    listener: ProgressListener,
) -> Iterator[PhotoCalibration]:
    """Calibrate the camera that took photographs of a field, for a block that writes the results.

    The camera's tone curve and all measurements are kept in a journal in `out`. If the work or the
    block is interrupted, the same call resumes. The journal is deleted at the end of the block.

    Raises
    ------
    KgcpError
        If the photographs are by several cameras, or fewer than three can be used.
    """
    making = {
        **{f"the version of {name}": value for name, value in versions().items()},
        "the field": fingerprint(field),
        "the response": options.response.value,
        "the operator": options.operator.value,
    }
    kinds: tuple[type[_Kept], ...] = (PhotoDiscs, PhotoMiss, CameraTone)
    path, is_new = out / ".calibration.journal", options.is_restart
    with Journal(path, making, kinds, is_new=is_new) as journal:
        yield _calibrated(journal, photos, field, out, options, listener)
        journal.remove()


@single_threaded()
def _calibrated(
    journal: Journal[_Kept],
    photos: Sequence[Photo],
    field: AnyField,
    out: Path,
    options: CalibrationOptions,
    listener: ProgressListener,
) -> PhotoCalibration:
    task = PhotoTask(field, options.response, options.operator)
    with open_pool(options.jobs, _CALL_LIMIT_S, None, out) as pool:
        task = replace(task, camera=_camera_of(journal, pool, task, photos))
        looks = _Looks(journal, pool, listener, task.camera)
        first = looks.through(
            "photographs", photos, [photo.name for photo in photos], partial(measure_photo, task)
        )
        try:
            results = _without_duplicates(_of_one_camera(first))
            start = calibrate_camera(
                _views(results),
                field,
                _size(results),
                replace(options.settings, points=PointModel.FIXED, lens=LensModel.RADIAL),
            )
        except KgcpError:  # its remedy changes the field, the response or the photographs
            journal.remove()
            raise
        results = _second_pass(looks, task, photos, results, start)
        final = calibrate_camera(_views(results), field, _size(results), options.settings, start)
    camera = replace(final.camera, response=options.response)
    calibration = replace(final, camera=camera)
    return _outcome(photos, field, options, results, calibration)


def _camera_of(
    journal: Journal[_Kept], pool: WorkerPool, task: PhotoTask, photos: Sequence[Photo]
) -> CameraTone | None:
    """Learn the camera's tone curve and processing; None: every photograph learns its own."""
    step = max(len(photos) // LEARNED_FROM, 1)
    # evenly from the whole set; photographs that cannot be read are replaced by the next ones
    ordered = tuple(photo for first in range(step) for photo in photos[first::step])
    key = fingerprint("the camera", [_stamp(photo) for photo in ordered], ordered)
    kept = journal.get(key)
    learned: CameraTone | TaskFailure | None = kept if isinstance(kept, CameraTone) else None
    if learned is None:
        learn = partial(learn_from_photos, task, LEARNED_FROM)
        with closing(pool.map(learn, [ordered])) as outcomes:
            ((_, learned),) = outcomes
        if isinstance(learned, CameraTone):
            journal.add(key, learned)
    if isinstance(learned, TaskFailure):
        warnings.warn(
            "the tone curve is learned separately in every photograph, because the process that"
            " learned it from five of them has ended or taken too long; results differ slightly",
            KgcpWarning,
            stacklevel=2,
        )
        return None
    if learned is not None and not learned.is_reliable:
        warnings.warn(
            "the photographs are compressed so much that they hardly tell their tone curve: sizes"
            " of the discs, and places where the light falls off steeply, are less certain than"
            " stated; take them with less compression, or as PNG; if they are linear or sRGB, give"
            " --response",
            KgcpWarning,
            stacklevel=2,
        )
    return learned


class _Looks:
    """Looks at photographs by a pool of workers, with a journal of the results.

    Discs that were measured with another tone curve are measured anew. It may have changed because
    photographs were added or removed.
    """

    def __init__(
        self,
        journal: Journal[_Kept],
        pool: WorkerPool,
        listener: ProgressListener,
        tone: CameraTone | None,
    ) -> None:
        self._journal, self._pool, self._listener = journal, pool, listener
        self._tone = tone

    def through(
        self,
        stage: str,
        items: Sequence[_Item],
        names: Sequence[str],
        function: Callable[[_Item], PhotoDiscs | PhotoMiss],
    ) -> list[PhotoDiscs | PhotoMiss]:
        """Return the results of all items, in their order."""
        keys = [fingerprint(stage, self._tone, _stamp(item), item) for item in items]
        row_of = {id(item): row for row, item in enumerate(items)}
        results: dict[int, PhotoDiscs | PhotoMiss] = {}
        for row, key in enumerate(keys):
            kept = self._journal.get(key)
            if isinstance(kept, PhotoDiscs | PhotoMiss):
                results[row] = kept
        measured = sum(isinstance(result, PhotoDiscs) for result in results.values())
        self._listener.progress(stage, len(results), len(items), measured)
        remaining = (item for row, item in enumerate(items) if row not in results)
        with closing(self._pool.map(function, remaining)) as outcomes:
            for item, outcome in outcomes:
                row = row_of[id(item)]
                if isinstance(outcome, TaskFailure):
                    result: PhotoDiscs | PhotoMiss = PhotoMiss(
                        names[row], 0, 0, _LOSSES[outcome].value, ""
                    )
                else:
                    result = outcome
                    self._journal.add(keys[row], result)
                results[row] = result
                measured += isinstance(result, PhotoDiscs)
                self._listener.progress(stage, len(results), len(items), measured)
        return [results[row] for row in range(len(items))]


def _stamp(item: Photo | SecondLook) -> tuple[int, int] | None:
    path = item.path if isinstance(item, Photo) else item.photo.path
    (stamp,) = stamps_of(path.parent, [path.name])
    return stamp


def _of_one_camera(results: Sequence[PhotoDiscs | PhotoMiss]) -> list[PhotoDiscs | PhotoMiss]:
    """Return the results; photographs without the most frequent size become misses.

    Raises
    ------
    KgcpError
        If EXIF names several cameras or focal lengths.
    """
    found = [result for result in results if isinstance(result, PhotoDiscs)]
    lenses = Counter((result.exif_camera.name, result.exif_camera.focal_mm) for result in found)
    # photographs without a focal length in their EXIF may have any
    for name in {"", *(name for name, focal_mm in lenses if focal_mm is not None)}:
        del lenses[name, None]
    if len(lenses) > 1:
        (first, first_count), (second, second_count) = lenses.most_common(2)
        raise KgcpError(
            "the photographs are by several cameras or focal lengths:"
            f" {first_count} by {_lens_text(*first)}, {second_count} by {_lens_text(*second)};"
            " calibrate them separately"
        )
    sizes = Counter((result.width, result.height) for result in found)
    if not sizes:
        return list(results)
    usual = max(sizes, key=lambda size: (sizes[size], size))
    return [
        result
        if isinstance(result, PhotoMiss) or (result.width, result.height) == usual
        else PhotoMiss(
            result.photo,
            result.width,
            result.height,
            OTHER_SIZE,
            f"{result.width} x {result.height} px, {sizes[usual]} of {len(found)} have"
            f" {usual[0]} x {usual[1]}"
            + (", which is transposed" if (result.height, result.width) == usual else ""),
        )
        for result in results
    ]


def _lens_text(camera: str, focal_mm: float | None) -> str:
    return " ".join(filter(None, (camera, f"{focal_mm:g} mm" if focal_mm is not None else "")))


def _without_duplicates(
    results: Sequence[PhotoDiscs | PhotoMiss],
) -> list[PhotoDiscs | PhotoMiss]:
    """Return the results; of photographs with identical discs, all but the first become misses."""
    first_of: dict[bytes, str] = {}
    kept: list[PhotoDiscs | PhotoMiss] = []
    for result in results:
        if isinstance(result, PhotoDiscs):
            first = first_of.setdefault(result.vectors.tobytes(), result.photo)
            if first != result.photo:
                size = (result.width, result.height)
                result = PhotoMiss(result.photo, *size, DUPLICATE, f"of {first}")  # noqa: PLW2901
        kept.append(result)
    return kept


def _views(results: Sequence[PhotoDiscs | PhotoMiss]) -> list[NamedView]:
    found = [result for result in results if isinstance(result, PhotoDiscs)]
    if len(found) < LEAST_VIEWS:
        raise KgcpError(
            f"{len(found)} of {len(results)} photographs can be used, and {LEAST_VIEWS} are needed;"
            f" {_about_misses(results) or 'take more, 12 at best'}"
        )
    return [
        NamedView(
            result.photo,
            result.point.astype(np.intp),
            result.vectors,
            result.covs,
            result.is_symmetric,
        )
        for result in found
    ]


def _about_misses(results: Sequence[PhotoDiscs | PhotoMiss]) -> str:
    """Return numbers of photographs left out by reason, most frequent first, and remedies."""
    misses: dict[str, list[PhotoMiss]] = {}
    for result in results:
        if isinstance(result, PhotoMiss):
            misses.setdefault(result.reason, []).append(result)
    is_any_found = any(isinstance(result, PhotoDiscs) for result in results)
    counts, remedies = [], []
    for reason in sorted(misses, key=lambda reason: -len(misses[reason])):
        first = misses[reason][0]
        example = f"{first.photo}: {first.detail}" if first.detail else first.photo
        counts.append(f"{len(misses[reason])} {reason} ({example})")
        is_unseen = reason == NamingProblem.TOO_FEW and not is_any_found
        remedies.append(_NONE_FOUND_REMEDY if is_unseen else _REMEDIES[reason])
    return f"left out: {', '.join(counts)}; {'; '.join(remedies)}" if counts else ""


def _size(results: Sequence[PhotoDiscs | PhotoMiss]) -> tuple[int, int]:
    first = next(result for result in results if isinstance(result, PhotoDiscs))
    return first.width, first.height


def _second_pass(
    looks: _Looks,
    task: PhotoTask,
    photos: Sequence[Photo],
    results: Sequence[PhotoDiscs | PhotoMiss],
    start: CameraCalibration,
) -> list[PhotoDiscs | PhotoMiss]:
    """Search for discs that the first pass did not find, at their predicted places."""
    places = {photo.name: photo for photo in photos}
    by_name = {result.photo: result for result in results}
    second = []
    for name, (point, predicted) in missing_discs(start).items():
        first = by_name[name]
        if isinstance(first, PhotoDiscs) and len(point):
            second.append(SecondLook(places[name], first, predicted, point.astype(np.float64)))
    if second:
        names = [look.photo.name for look in second]
        function = partial(measure_photo_again, task)
        for result in looks.through("second pass", second, names, function):
            if isinstance(result, PhotoDiscs):  # after a failure, keep the result of the first pass
                by_name[result.photo] = result
    return [by_name[result.photo] for result in results]


def _outcome(
    photos: Sequence[Photo],
    field: AnyField,
    options: CalibrationOptions,
    results: Sequence[PhotoDiscs | PhotoMiss],
    calibration: CameraCalibration,
) -> PhotoCalibration:
    used = {view.photo for view in calibration.views}
    discs, misses = {}, []
    for result in results:
        if isinstance(result, PhotoMiss):
            misses.append(result)
        elif result.photo in used:
            discs[result.photo] = result
        else:
            size = (result.width, result.height)
            misses.append(PhotoMiss(result.photo, *size, UNLIKE_FIELD, ""))
    names = tuple(photo.name for photo in photos)
    exif = ExifCamera.shared_by([result.exif_camera for result in discs.values()])
    return PhotoCalibration(field, options, calibration, discs, tuple(misses), names, exif)
