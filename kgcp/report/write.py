"""The report's files."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from kgcp.bias.study import BiasStudy
from kgcp.errors import KgcpError
from kgcp.io.columns import BIAS_COLUMNS
from kgcp.io.flight import Flight
from kgcp.io.kgcp_table import bias_row
from kgcp.io.provenance import provenance
from kgcp.io.tables import write_table
from kgcp.io.wholefile import write_bytes
from kgcp.report.figures import detection_rate, error_against_distance, error_against_exposure
from kgcp.report.numbers import BiasNumbers, bias_numbers
from kgcp.report.page import render_page, verdict

FIGURE_FILES = {
    "error": "bias_error.png",
    "rate": "bias_detection_rate.png",
    "exposure": "bias_exposure.png",
}


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """What was written, and what it says."""

    numbers: BiasNumbers
    verdict: tuple[str, ...]
    files: tuple[Path, ...]

    def summary(self) -> dict[str, object]:
        """Return the main numbers for machines: percent, metres, counts, paths."""
        numbers = self.numbers
        return {
            "compared": numbers.total.percent.count,
            "residual_percent": asdict(numbers.total.percent),
            "residual_m": asdict(numbers.total.metres),
            "biased": [row.label for row in numbers.biased],
            "detected": numbers.detected,
            "frames_with_target": numbers.chances,
            "astray": len(numbers.astray),
            "left_out": dict(numbers.left_out),
            "files": [str(path) for path in self.files],
        }


def write_report(study: BiasStudy, flight: Flight, folder: Path) -> Report:
    """Write bias.parquet, the figures and bias_report.html into a folder.

    Raises
    ------
    KgcpError
        If no measurement can be compared, or a file cannot be written.
    """
    if not study.trusted:
        raise KgcpError(
            f"none of {len(study.measured)} measurements lies where a reference pose and the"
            " trajectory put the target; check [reference] poses, [vehicle] trajectory and crs"
        )
    table = folder / "bias.parquet"
    write_table(table, BIAS_COLUMNS, map(bias_row, study.measured), provenance(flight))
    numbers = bias_numbers(study)
    figures = _figures(numbers)
    page = render_page(flight.name, numbers, figures)
    contents = {FIGURE_FILES[name]: png for name, png in figures.items()}
    contents["bias_report.html"] = page.encode("utf-8")
    for name, content in contents.items():
        write_bytes(folder / name, content)
    files = (table, *(folder / name for name in contents))
    return Report(numbers, tuple(verdict(numbers)), files)


def _figures(numbers: BiasNumbers) -> dict[str, bytes]:
    figures = {
        "error": error_against_distance(
            numbers.distance_m, numbers.residual_m, numbers.residual_percent
        )
    }
    if numbers.rates:
        figures["rate"] = detection_rate(numbers.rates)
    if numbers.influences:
        figures["exposure"] = error_against_exposure(numbers.influences)
    return figures
