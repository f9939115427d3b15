"""A simulated flight without images: the values that instruments and detector would give."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtri

from kgcp.georef.sighting import Attempt, Exposure, Sighting
from kgcp.georef.target_positions import TargetPositions
from kgcp.quality.bias_study import BiasStudy, study_bias
from kgcp.settings import Method
from kgcp.simulation.flight import CRS, TARGET_PLATE, FramePlan, frame_name, plan_flight
from kgcp.simulation.presets import preset

SD_EDGE_PX = 0.01

Fly = Callable[..., BiasStudy]


def shift_px(white: float, blur_px: float) -> float:
    """δ of a linear sensor that clips at 1: half of what is seen is less than half the light."""
    return float(-blur_px * ndtri(0.5 * min(1.0, 1.0 / white)))


def attempt(
    frame: FramePlan, name: str, method: Method, scale: float, rng: np.random.Generator
) -> Attempt:
    settings = preset("exposure_sweep")
    distance = frame.target.distance_m
    radius = 0.45 * settings.camera.mean_focal_px / distance
    white, blur = 0.85 * frame.gain, float(np.hypot(frame.optics.psf_px, 0.29))
    delta = shift_px(white, blur) if white > 1.0 else 0.0
    edge = SD_EDGE_PX * rng.standard_normal()
    two_m = distance * (1.0 + scale) * (1.0 + edge / radius)
    if method is Method.PAPER:
        measured, radius = two_m * radius / (radius - delta), radius - delta
    else:
        measured = two_m
    exposure = Exposure(
        radius_px=radius,
        blur_px=blur + 0.02 * rng.standard_normal(),
        edge_shift_px=delta + 0.003 * rng.standard_normal(),
        black=0.04 * frame.gain,
        white=min(1.0, white),
        saturated=0.4 * (white > 1.0),
        exposure_time_s=0.001 * frame.gain,
        iso=100.0,
        f_number=5.6,
    )
    sighting = Sighting(
        frame=name,
        number=frame.index + 1,
        target=TARGET_PLATE.target.name,
        instance=0,
        time_s=frame.time_s,
        centre_px=settings.camera.project(frame.target.translation_m[None])[0],
        centre_cov_px2=None,
        distance_m=measured,
        sd_distance_m=SD_EDGE_PX * distance / radius,
        sd_common_distance_m=None,
    )
    return Attempt(name, TARGET_PLATE.target.name, frame.time_s, sighting, exposure)


@pytest.fixture(scope="session")
def fly() -> Fly:
    """Fly with errors: a relative one of the scale, and a target that lies so much lower."""

    def flight(
        seed: int,
        method: Method = Method.MODEL,
        scale: float = 0.0,
        offset_m: float = 0.0,
        frames: int = 120,
    ) -> BiasStudy:
        settings = replace(
            preset("exposure_sweep"), frames=frames, absent_share=0.0, sd_lever_arm_m=0.0
        )
        plan = plan_flight(settings, seed)
        rng = np.random.default_rng(seed)
        attempts = [
            attempt(frame, frame_name(settings, frame.index), method, scale, rng)
            for frame in plan.frames
        ]
        forward, right, down = plan.vehicle.lever_arm_m
        vehicle = replace(plan.vehicle, lever_arm_m=(forward, right, down - offset_m))
        target_positions = TargetPositions.of(CRS, [TARGET_PLATE.target], plan.trajectory, vehicle)
        targets = [TARGET_PLATE.target]
        return study_bias(
            attempts, plan.reference, target_positions, settings.camera, targets, method
        )

    return flight
