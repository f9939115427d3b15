"""Pages of a PDF as PNG with their resolution."""

from __future__ import annotations

import io
from collections.abc import Iterator

import pypdfium2

from kgcp.errors import SettingError

_MM_PER_INCH = 25.4
_POINTS_PER_INCH = 72.0
_MOST_PIXELS = 400e6


def check_pixels(width_mm: float, height_mm: float, dpi: int) -> None:
    """Refuse pictures of more pixels than most programs open.

    Raises
    ------
    SettingError
    """
    pixels = width_mm * height_mm * (dpi / _MM_PER_INCH) ** 2
    if pixels > _MOST_PIXELS:
        most = int(dpi * (_MOST_PIXELS / pixels) ** 0.5)
        raise SettingError(
            "dpi",
            f"{dpi} makes {pixels / 1e6:.0f} million pixels of {width_mm:.0f} × {height_mm:.0f} mm",
            f"give at most {most}, or take PDF, SVG or DXF",
        )


def pngs_of(pdf: bytes, dpi: int) -> Iterator[bytes]:
    """Yield the pages of a PDF file as grey pictures."""
    document = pypdfium2.PdfDocument(pdf)
    try:
        for page in document:
            picture = page.render(scale=dpi / _POINTS_PER_INCH, grayscale=True).to_pil()
            stream = io.BytesIO()
            picture.convert("L").save(stream, format="PNG", dpi=(dpi, dpi))
            yield stream.getvalue()
    finally:
        document.close()
