"""The calibration report as one self-contained HTML page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.calibration import CALIBRATION_PARAMETERS
from kgcp.geometry.camera import Camera
from kgcp.io.tables.calibration import PhotoRow
from kgcp.network.calibration_records import CameraCalibration, PointModel
from kgcp.network.camera_network import observed_circles
from kgcp.quality.calibration_verdict import (
    CalibrationNumbers,
    CalibrationVerdict,
    change_if_neglected,
)
from kgcp.quality.eccentricity import EccentricitySummary, summarise_eccentricity
from kgcp.quality.frame_rays import CameraDifference
from kgcp.quality.number_text import minus
from kgcp.report.html_page import embedded_pictures, page_template

_MUCH_LESS = 0.7  # share of the RMS below which the misfit is worth reading, too
_PIXEL_PARAMETERS = 4  # the first ones are lengths in pixels


@dataclass(frozen=True, slots=True, eq=False)
class CameraComparison:
    """The camera compared with that of another calibration."""

    name: str
    camera: Camera
    difference: CameraDifference
    convention: str  # from `convention_words`

    @property
    def sentence(self) -> str:
        """The difference, and what explains it if one convention does."""
        sizes = f"{self.difference.rms_px:.3f} px (RMS; at most {self.difference.largest_px:.3f} px"
        return f"{self.name}: images of rays differ by {sizes}). {self.convention}".rstrip()

    def numbers(self, camera: Camera) -> dict[str, object]:
        """Return the entry of calibration.json; changes are `camera` minus the other camera."""
        changes = {
            name: getattr(camera, name) - getattr(self.camera, name)
            for name in CALIBRATION_PARAMETERS
        }
        sizes = {"rms_px": self.difference.rms_px, "largest_px": self.difference.largest_px}
        return {"file": self.name, **sizes, "change": changes, "convention": self.convention}


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationPage:
    """All that the page shows."""

    calibration: CameraCalibration
    numbers: CalibrationNumbers
    verdict: CalibrationVerdict
    photos: Sequence[PhotoRow]
    figures: Mapping[str, bytes]  # PNG, by name
    files: Sequence[str]
    comparison: CameraComparison | None = None


@dataclass(frozen=True, slots=True)
class ParameterRow:
    """A row of the camera's table, as text."""

    name: str
    value: str
    sd: str
    note: str


def render_calibration(page: CalibrationPage) -> str:
    """Return the page."""
    return page_template("calibration.html").render(
        page=page,
        calibration=page.calibration,
        numbers=page.numbers,
        verdict=page.verdict,
        verdict_class=page.verdict.grade.name.lower(),
        parameters=parameter_rows(page.calibration),
        correlations=_correlations(page.calibration),
        fit=fit_words(page.calibration),
        datum=datum_words(page.calibration),
        eccentricity=_eccentricity(page.calibration),
        neglected=neglected_words(page.calibration),
        ray_sd_px=page.numbers.mean_ray_sd_px,
        images=embedded_pictures(page.figures),
    )


def parameter_rows(calibration: CameraCalibration) -> list[ParameterRow]:
    """Return a row for every parameter that is not zero or was estimated."""
    sd = np.sqrt(calibration.covariance.cov.diagonal())
    rows = []
    for index, name in enumerate(CALIBRATION_PARAMETERS):
        value = float(getattr(calibration.camera, name))
        if value == 0.0 and sd[index] == 0.0:
            continue
        digits = 3 if index < _PIXEL_PARAMETERS else 6
        notes = []
        if name in calibration.insignificant:
            notes.append("not significant; kept as small as usual lenses have it")
        if name in calibration.undetermined:
            notes.append("not determined")
        if name in calibration.tangled:
            others = [other for other in calibration.tangled if other != name]
            notes.append(f"cannot be separated from {', '.join(others)}")
        unit = " px" if index < _PIXEL_PARAMETERS else ""
        rows.append(
            ParameterRow(
                name,
                minus(f"{value:.{digits}f}") + unit,
                f"{sd[index]:.{digits}f}{unit}",
                "; ".join(notes),
            )
        )
    return rows


def fit_words(calibration: CameraCalibration) -> str:
    """Return one sentence on the residuals and on parameters that are not determined."""
    weak = (
        (calibration.undetermined, "not determined by these photographs"),
        (calibration.tangled, "cannot be separated"),
    )
    remarks = [f"{', '.join(names)} {remark}" for names, remark in weak if names]
    determined = "; ".join(remarks) or "all parameters are determined"
    misfit = ""
    if calibration.misfit_px < _MUCH_LESS * calibration.rms_px:
        misfit = f" ({calibration.misfit_px:.3f} px if discs measured worse than most count less)"
    return (
        f"The RMS of the residuals is {calibration.rms_px:.3f} px{misfit}, the standard deviation"
        f" of a measured disc {calibration.operator_sd_px:.3f} px; {determined}."
    )


def datum_words(calibration: CameraCalibration) -> str:
    """Return the sentences on the datum of the field: shift, rotation and scale."""
    has_bars = bool(calibration.field.bars)
    sentences = ["The scale comes from the bars."] if has_bars else []
    if calibration.points_used is PointModel.FREE:
        datum = "Shift and rotation" if has_bars else "Shift, rotation and scale"
        sentences.append(f"{datum} are those of the nominal field.")
    return " ".join(sentences)


def neglected_words(calibration: CameraCalibration) -> str:
    """Return the error of the camera if eccentricities are neglected, as text."""
    change = change_if_neglected(calibration)
    focal = change["fx"] / calibration.camera.fx
    fx, share, cx, cy = (
        minus(text)
        for text in (
            f"{change['fx']:+.3f}",
            f"{100.0 * focal:+.4f}",
            f"{change['cx']:+.3f}",
            f"{change['cy']:+.3f}",
        )
    )
    return f"{fx} px in fx ({share} %), {cx} and {cy} px in the principal point"


def _correlations(calibration: CameraCalibration) -> tuple[list[str], list[list[str]]]:
    """Return names and the lower triangle of the correlations, as text."""
    cov = calibration.covariance.cov
    estimated = [index for index in range(len(cov)) if cov[index, index] > 0.0]
    sd = np.sqrt(cov.diagonal()[estimated])
    correlation = cov[np.ix_(estimated, estimated)] / np.outer(sd, sd)
    texts = [
        [minus(f"{correlation[row, column]:.2f}") for column in range(row + 1)]
        for row in range(len(estimated))
    ]
    return [CALIBRATION_PARAMETERS[index] for index in estimated], texts


def _eccentricity(calibration: CameraCalibration) -> EccentricitySummary:
    """Return sizes, tilts and eccentricities of the imaged discs."""
    circles = observed_circles(
        calibration.field, calibration.solution.estimate, calibration.network.observations
    )
    return summarise_eccentricity(calibration.camera, circles)
