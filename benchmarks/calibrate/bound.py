"""Cramér-Rao bound of the centroid of a disc or a ring, from exact renderings.

The unknowns besides the centroid are diameter and tilt, point spread, two levels, the gradient of
the light, and two bends of the tone curve if the camera's response is unknown. The texture of the
ground is a random field with known standard deviation and correlation. Pixels farther from the edge
than `AROUND_PX` are not used, because on a board they belong to other discs.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose, rotation_about
from kgcp.measurement.discs.ground_texture import GroundTexture
from kgcp.simulation.crlb import censored_information
from kgcp.simulation.disc_field import FieldScene, field_irradiance
from kgcp.simulation.imaging import Optics, Sensor

AROUND_PX = 6.0
_STEP_PX = 0.02
_GREY_VALUES = 255.0


def centroid_bound(
    camera: Camera,
    scene: FieldScene,
    optics: Optics,
    sensor: Sensor,
    gain: float,
    *,
    tone_is_unknown: bool,
    texture: GroundTexture | None = None,
) -> FloatArray:
    """Return the smallest covariance (2, 2) of the centroid of a scene's only disc [px²].

    The disc is at a distance of 1 in front of the camera, and so small that its image is affine.
    """
    (disc,) = scene.discs
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 1.0]))
    middle = 0.5 * np.array([camera.width - 1, camera.height - 1])

    def light(**changes: object) -> FloatArray:
        changed = replace(scene, **changes)  # type: ignore[arg-type]
        return field_irradiance(camera, pose, changed, optics)

    def of_disc(**changes: object) -> FloatArray:
        return light(discs=(replace(disc, **changes),))  # type: ignore[arg-type]

    def slope(plus: FloatArray, minus: FloatArray) -> FloatArray:
        return np.asarray((plus - minus) / (2.0 * _STEP_PX))

    step_m = _STEP_PX / camera.fx
    x, y, z = disc.position_m
    hole = disc.inner_diameter_m / disc.diameter_m  # ratio that stays the same if the disc grows
    columns = [
        slope(of_disc(position_m=(x + step_m, y, z)), of_disc(position_m=(x - step_m, y, z))),
        slope(of_disc(position_m=(x, y + step_m, z)), of_disc(position_m=(x, y - step_m, z))),
        slope(
            *(
                of_disc(diameter_m=diameter_m, inner_diameter_m=hole * diameter_m)
                for diameter_m in (disc.diameter_m + step_m, disc.diameter_m - step_m)
            )
        ),
    ]
    if disc.normal[2] < 0.999:  # otherwise a tilt has no first-order effect
        turn = _STEP_PX / (camera.fx * disc.diameter_m)
        for axis in np.eye(3)[:2]:
            plus, minus = (
                tuple((rotation_about(sign * turn * axis) @ disc.normal).tolist())
                for sign in (1.0, -1.0)
            )
            columns.append(slope(of_disc(normal=plus), of_disc(normal=minus)))
    blurs = [replace(optics, psf_px=optics.psf_px + sign * _STEP_PX) for sign in (1.0, -1.0)]
    columns.append(slope(*(field_irradiance(camera, pose, scene, blur) for blur in blurs)))
    columns += [light(ground=1.0, ink=0.0), light(ground=0.0, ink=1.0)]
    radius_px = 0.5 * disc.diameter_m * camera.fx
    for k in range(2):
        more, less = list(scene.gradient), list(scene.gradient)
        more[k], less[k] = more[k] + 0.01 / radius_px, less[k] - 0.01 / radius_px
        columns.append(slope(light(gradient=tuple(more)), light(gradient=tuple(less))))
    seen = light()
    exposure = gain * seen
    tone_slope = sensor.tone.slope(np.minimum(exposure, 1.0))
    if tone_is_unknown:
        share = (seen - seen.min()) / (seen.max() - seen.min())
        bend = share * (1.0 - share) / tone_slope
        columns += [bend, bend * (2.0 * share - 1.0)]
    variance = (sensor.full_well_e * exposure + sensor.read_noise_e**2) / sensor.full_well_e**2
    variance = variance + 1.0 / 12.0 / (_GREY_VALUES * tone_slope) ** 2
    information = censored_information((1.0 - exposure) / np.sqrt(variance)) * gain**2 / variance
    rows, places = np.mgrid[0 : camera.height, 0 : camera.width]
    off = np.stack((places.ravel() - middle[0], rows.ravel() - middle[1]))
    used = np.hypot(*off) <= radius_px + AROUND_PX
    jacobian = np.stack([column.ravel()[used] for column in columns])
    scales = np.linalg.norm(jacobian, axis=1)
    jacobian /= scales[:, None]
    weighted = jacobian * information.ravel()[used]
    if texture is not None:
        off = off[:, used]
        distances_px = np.hypot(*(np.subtract.outer(each, each) for each in off))
        noise = np.diag(1.0 / information.ravel()[used])
        of_ground = light(ground=1.0, ink=0.0).ravel()[used]
        weighted = np.linalg.solve(noise + texture.cov(distances_px, of_ground), jacobian.T).T
    inverse = np.linalg.inv(weighted @ jacobian.T)
    return np.asarray(inverse[:2, :2] / np.outer(scales[:2], scales[:2]))
