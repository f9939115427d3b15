"""What all packages that take distances must be told about them."""

from __future__ import annotations

from collections.abc import Iterable

from kgcp.kgcps import Kgcp

_NOTE = """\
Distances and the focal length: kgcp measures with the calibration of flight.toml. If its focal
length is wrong by 0.1 %, all distances are wrong by 0.1 %, 8 cm at 80 m, and so with the printed
diameter. {known}
The accuracies are those of single distances, without this common error. So leave the calibration
free in the adjustment. Where the focal length is not known far better than single distances,
enlarge their accuracies to sqrt(accuracy^2 + (share x distance)^2). If the adjusted focal length
is another one, put the new calibration into flight.toml and begin again with kgcp detect.
"""


def focal_length_note(kgcps: Iterable[Kgcp]) -> str:
    """Return lines for a HOWTO: how distances hang on the focal length, and how much in these."""
    shares = [
        point.sd_common_distance_m / point.distance_m
        for point in kgcps
        if point.sd_common_distance_m is not None
    ]
    if not shares:
        return _NOTE.format(
            known="How well they are known, flight.toml does not say (sd_fx, sd_outer_diameter_m)."
        )
    percent = 100.0 * max(shares)
    return _NOTE.format(
        known=f"By flight.toml (sd_fx, sd_outer_diameter_m) the share is {percent:.2g} % here."
    )
