"""Sessions of photographs of a field: the whole board, from all sides."""

from __future__ import annotations

import numpy as np

from kgcp.geometry.camera import Camera
from kgcp.simulation.field_session import FieldSession, field_photograph, printed_points
from kgcp.targets.fields.layout import Field, GridKind

CAMERA = Camera(160, 120, 170.0, 170.0, 82.0, 58.0, -0.1)
BOARD = Field("board", GridKind.SQUARE, 4, 3, 0.03, 0.016, flat_sd_m=(0.0001, 0.0001, 0.0004))


def test_every_photograph_shows_the_whole_board() -> None:
    session = FieldSession(CAMERA, BOARD, photographs=4)
    rng = np.random.default_rng(1)
    points = printed_points(session, rng)
    off = points - BOARD.points_m()
    assert 0.0001 < np.sqrt(np.mean(off[:, 2] ** 2)) < 0.0008
    tilts = []
    for number in range(session.photographs):
        photo = field_photograph(session, points, number, rng)
        places = CAMERA.project(photo.pose.transform(points))
        assert np.all((places > 5.0) & (places < (154.0, 114.0)))
        columns, rows = np.rint(places).astype(int).T
        assert photo.grey.shape == (120, 160)
        assert photo.grey[rows, columns].max() < 0.5 * np.median(photo.grey)
        tilts.append(np.degrees(np.arccos(photo.pose.rotation[2, 2])))
    assert min(tilts) > 14.0
    assert max(tilts) < 41.0
