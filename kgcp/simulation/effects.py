"""Strengths of the effects of real light and cameras in a simulated flight, in one or two numbers.

The neutral value is 1 for the share of light behind a shadow and for the ratio of astigmatism, and
0 for all others. The exposure has no neutral value.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

from kgcp.geometry.camera import Response
from kgcp.simulation.light_settings import Dirt, Glare, Shadow
from kgcp.simulation.point_spread import Aberration
from kgcp.simulation.presets import SimulationSettings, preset
from kgcp.simulation.rolling_shutter import ImageMotion

_MIN_PEAK_RATIO = 1.0 / 3.0  # of the smallest to the largest peak of highlights


@dataclass(frozen=True, slots=True)
class Effects:
    """Strength of each effect."""

    # range of the exposure, relative to the one at which radiance 1 fills the well
    gain: tuple[float, float] = (0.7, 1.0)
    shadow: float = 1.0  # share of the light that remains behind a shadow edge; 1: no edge
    stripes: int = 0  # number of stripe-shaped shadows
    dirt: float = 0.0  # relative standard deviation of the reflectance
    stains: int = 0  # number of stains
    # peak of highlights, as a share of full scale; it varies between a third of this and this
    glare: float = 0.0
    astigmatism: float = 1.0  # ratio of the largest σ of the point spread to the smallest
    coma: float = 0.0  # third central moment of the point spread along its tail, over psf³
    defocus: float = 0.0  # radius of the disc that a point becomes by defocus [px]
    sharpening: tuple[float, float] = (0.0, 1.0)  # strength of the unsharp mask, and its σ [px]
    phone: bool = False  # whether frames are processed as by a phone
    rolling: float = 0.0  # time from the first row to the last [s]
    # motion of the image during that time [px/s]; None: random, anew in each frame
    motion: tuple[float, float] | None = None

    @classmethod
    def of(cls, settings: SimulationSettings) -> Effects:
        """Return the strengths in a flight's settings."""
        shadow = settings.shadow or Shadow(edges=0)
        dirt = settings.dirt or Dirt(sd=0.0, stains=0)
        lens = settings.lens or Aberration()
        return cls(
            gain=settings.gain,
            shadow=shadow.light_left if shadow.edges else 1.0,
            stripes=shadow.stripes,
            dirt=dirt.sd,
            stains=dirt.stains,
            glare=settings.glare.peak[1] if settings.glare else 0.0,
            astigmatism=lens.astigmatism,
            coma=lens.coma,
            defocus=lens.defocus_px,
            sharpening=(settings.sensor.sharpening, settings.sensor.sharpening_px),
            phone=settings.phone is not None,
            rolling=settings.camera.readout_s,
            motion=None if settings.motion.sd_px_s else settings.motion.mean_px_s,
        )


def with_phone(settings: SimulationSettings, *, is_phone: bool) -> SimulationSettings:
    """Return a flight's settings with a phone's processing, which sharpens, or without it."""
    return with_effects(settings, replace(Effects.of(settings), phone=is_phone))


def with_effects(settings: SimulationSettings, wanted: Effects) -> SimulationSettings:
    """Return a flight's settings with other strengths of some effects.

    Other parameters of an effect keep the value in the settings, or get their default if the
    settings lack the effect.
    """
    present = Effects.of(settings)
    settings = replace(settings, gain=wanted.gain)
    if (wanted.shadow, wanted.stripes) != (present.shadow, present.stripes):
        settings = replace(settings, shadow=_shadow(settings.shadow, wanted))
    if (wanted.dirt, wanted.stains) != (present.dirt, present.stains):
        dirt = replace(settings.dirt or Dirt(), sd=wanted.dirt, stains=wanted.stains)
        settings = replace(settings, dirt=dirt)
    if wanted.glare != present.glare:
        peak = (_MIN_PEAK_RATIO * wanted.glare, wanted.glare)
        settings = replace(settings, glare=replace(settings.glare or Glare(), peak=peak))
    lens = replace(
        settings.lens or Aberration(),
        astigmatism=wanted.astigmatism,
        coma=wanted.coma,
        defocus_px=wanted.defocus,
    )
    if lens != (settings.lens or Aberration()):
        settings = replace(settings, lens=lens)
    if wanted.phone != present.phone:
        settings = _as_of_a_phone(settings) if wanted.phone else replace(settings, phone=None)
    if wanted.sharpening != present.sharpening:
        settings = _sharpened(settings, *wanted.sharpening)
    if wanted.rolling != present.rolling:
        camera = replace(settings.camera, readout_s=wanted.rolling)
        settings = replace(settings, camera=camera)
    if wanted.motion != present.motion:
        motion = ImageMotion() if wanted.motion is None else ImageMotion(wanted.motion, 0.0)
        settings = replace(settings, motion=motion)
    return settings


def _shadow(shadow: Shadow | None, wanted: Effects) -> Shadow:
    """Return a shadow with the wanted stripes, and with an edge unless all light remains.

    Without an edge, the light in stripes is that of the settings, or the default of `Shadow`.
    """
    shadow = replace(shadow or Shadow(), stripes=wanted.stripes)
    if wanted.shadow == 1.0:
        return replace(shadow, edges=0)
    return replace(shadow, edges=max(shadow.edges, 1), light_left=wanted.shadow)


def _as_of_a_phone(settings: SimulationSettings) -> SimulationSettings:
    phone = preset("phone")
    return replace(
        settings,
        phone=phone.phone,
        sensor=phone.sensor,
        camera=replace(settings.camera, response=phone.camera.response),
        jpeg_quality=phone.jpeg_quality,
    )


def _sharpened(
    settings: SimulationSettings, strength: float, sharpening_px: float
) -> SimulationSettings:
    """Return settings with sharpening; nobody would state a linear response for such a camera."""
    sensor = replace(settings.sensor, sharpening=strength, sharpening_px=sharpening_px)
    camera = settings.camera
    if strength > 0.0 and camera.response is Response.LINEAR:
        camera = replace(camera, response=Response.UNKNOWN)
    return replace(settings, sensor=sensor, camera=camera)


def effect_options(settings: SimulationSettings) -> str:
    """Return the options by which a flight's effects differ from those of its preset."""
    effects, start = Effects.of(settings), preset(settings.name)
    usual = asdict(Effects.of(with_phone(start, is_phone=effects.phone)))
    usual["phone"] = Effects.of(start).phone
    words = []
    for name, value in asdict(effects).items():
        if value == usual[name]:
            continue
        if isinstance(value, bool):
            words.append(f" --{name}" if value else f" --no-{name}")
        elif value is not None:
            numbers = value if isinstance(value, tuple) else (value,)
            words.append(f" --{name} " + " ".join(f"{number:g}" for number in numbers))
    return "".join(words)
