"""What EXIF says about the camera of photographs, and whether two of them are the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

FOCUS_FACTOR = 1.03
"""Factor by which focusing changes a focal length in EXIF."""

_ROUNDING_35_MM = 1.0  # difference of two equivalents that are rounded to whole millimetres


@dataclass(frozen=True, slots=True)
class ExifCamera:
    """What EXIF says about the camera that took a photograph, or all photographs of a set.

    Attributes
    ----------
    name : str
        Maker, model and serial number; empty: not known.
    focal_mm, focal_35_mm : float or None
        Focal length, and that of a small-format camera with the same angle of view [mm]; None: not
        known.
    """

    name: str = ""
    focal_mm: float | None = None
    focal_35_mm: float | None = None

    @classmethod
    def shared_by(cls, cameras: Sequence[ExifCamera]) -> ExifCamera:
        """Return what all of them that state it agree on."""
        names = {camera.name for camera in cameras if camera.name.isprintable()} - {""}
        focals_mm = {camera.focal_mm for camera in cameras} - {None}
        focals_35_mm = {camera.focal_35_mm for camera in cameras} - {None}
        return cls(
            names.pop() if len(names) == 1 else "",
            focals_mm.pop() if len(focals_mm) == 1 else None,
            focals_35_mm.pop() if len(focals_35_mm) == 1 else None,
        )

    def difference(self, other: ExifCamera) -> tuple[str, str]:
        """Return camera, zoom or crop of this one and of another if they differ; otherwise "".

        Either may lack the serial number.
        """
        own_name, other_name = self.name.casefold(), other.name.casefold()
        is_same = own_name.startswith(other_name) or other_name.startswith(own_name)
        if own_name and other_name and not is_same:
            return self.name, other.name
        for own_mm, other_mm, rounding_mm, kind in (
            (self.focal_mm, other.focal_mm, 0.0, ""),
            (self.focal_35_mm, other.focal_35_mm, _ROUNDING_35_MM, " (35 mm equivalent)"),
        ):
            if own_mm is None or other_mm is None:
                continue
            if max(own_mm, other_mm) > FOCUS_FACTOR * min(own_mm, other_mm) + rounding_mm:
                return f"{own_mm:g} mm{kind}", f"{other_mm:g} mm{kind}"
        return "", ""
