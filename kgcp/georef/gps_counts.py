"""Times that do not count from 1970: seconds of a GPS week, and GPS seconds since 1980."""

from __future__ import annotations

from kgcp.georef.unix_time import date_of

_DAY_S = 86400.0
# More than any seconds of the week, even if they count on beyond the week's end during a flight.
_TWO_WEEKS_S = 14 * _DAY_S
_GPS_EPOCH_S = 315_964_800  # 1980-01-06 as Unix seconds


def gps_count_remedy(frames_s: float, trajectory_s: float) -> str | None:
    """Return what to do about times that count from the start of a GPS week, or from 1980.

    The arguments are the first times of the frames and of the trajectory, read as Unix seconds.
    None: both count from 1970.
    """
    if 0.0 <= trajectory_s < _TWO_WEEKS_S <= frames_s:
        return (
            "the trajectory's times are seconds of a GPS week: give [vehicle] date ="
            f' {date_of(frames_s):%Y-%m-%d}, the day of its first epoch, and time_system = "gps" in'
            " flight.toml"
        )
    if 0.0 <= frames_s < _TWO_WEEKS_S <= trajectory_s:
        return (
            "the frames' times are seconds of a GPS week: subtract the leap seconds (18 since"
            " 2017), write them with their day, such as"
            f" {date_of(trajectory_s):%Y-%m-%dT%H:%M:%SZ}, and run 'kgcp detect' again"
        )
    for whose, behind_s in (
        ("trajectory's", frames_s - trajectory_s),
        ("frames'", trajectory_s - frames_s),
    ):
        if abs(behind_s - _GPS_EPOCH_S) < _DAY_S:
            return (
                f"the {whose} times count from 1980-01-06, as GPS does: to make them Unix seconds,"
                f" add {_GPS_EPOCH_S} s and subtract the leap seconds (18 since 2017)"
            )
    return None
