"""A number or two for each effect of real light: how strong it is in a simulated flight.

Without the effect they are neutral: 1 for the share of the light that is left and for the ratio of
the astigmatism, 0 for all others. The exposure is never without effect.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

from kgcp.geometry.camera import Response
from kgcp.simulation.light_settings import Dirt, Glare, Shadow
from kgcp.simulation.point_spread import Aberration
from kgcp.simulation.presets import SimulationSettings, preset
from kgcp.simulation.rolling_shutter import ImageMotion

_LEAST_PEAK = 1.0 / 3.0  # of the largest peak of highlights


@dataclass(frozen=True, slots=True)
class Effects:
    """Strength of each effect."""

    # range of the exposure, relative to the one at which radiance 1 fills the well
    gain: tuple[float, float] = (0.7, 1.0)
    shadow: float = 1.0  # share of the light that is left behind a shadow edge; 1: no edge
    stripes: int = 0  # number of stripe-shaped shadows
    dirt: float = 0.0  # relative standard deviation of the reflectance
    stains: int = 0  # number of stains
    # peak of highlights, as a share of full scale; it varies between a third of this and this
    glare: float = 0.0
    astigmatism: float = 1.0  # ratio of the largest σ of the point spread to the smallest
    coma: float = 0.0  # third central moment of the point spread along its tail, over psf³
    defocus: float = 0.0  # radius of the disc that a point becomes by defocus [px]
    sharpening: tuple[float, float] = (0.0, 1.0)  # strength of the unsharp mask, and its σ [px]
    phone: bool = False  # whether frames are processed as a phone does it
    rolling: float = 0.0  # time from the first row to the last [s]
    # motion of the image during that time [px/s]; None: random, anew in each frame
    motion: tuple[float, float] | None = None

    @classmethod
    def of(cls, settings: SimulationSettings) -> Effects:
        """Return the figures of a flight's settings."""
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

    Everything else about an effect stays as it is in the settings or, where they do not have the
    effect, as it is by default.
    """
    had = Effects.of(settings)
    settings = replace(settings, gain=wanted.gain)
    if (wanted.shadow, wanted.stripes) != (had.shadow, had.stripes):
        settings = replace(settings, shadow=_shadow(settings.shadow, wanted))
    if (wanted.dirt, wanted.stains) != (had.dirt, had.stains):
        dirt = replace(settings.dirt or Dirt(), sd=wanted.dirt, stains=wanted.stains)
        settings = replace(settings, dirt=dirt)
    if wanted.glare != had.glare:
        peak = (_LEAST_PEAK * wanted.glare, wanted.glare)
        settings = replace(settings, glare=replace(settings.glare or Glare(), peak=peak))
    lens = replace(
        settings.lens or Aberration(),
        astigmatism=wanted.astigmatism,
        coma=wanted.coma,
        defocus_px=wanted.defocus,
    )
    if lens != (settings.lens or Aberration()):
        settings = replace(settings, lens=lens)
    if wanted.phone != had.phone:
        settings = _as_of_a_phone(settings) if wanted.phone else replace(settings, phone=None)
    if wanted.sharpening != had.sharpening:
        settings = _sharpened(settings, *wanted.sharpening)
    if wanted.rolling != had.rolling:
        camera = replace(settings.camera, readout_s=wanted.rolling)
        settings = replace(settings, camera=camera)
    if wanted.motion != had.motion:
        motion = ImageMotion() if wanted.motion is None else ImageMotion(wanted.motion, 0.0)
        settings = replace(settings, motion=motion)
    return settings


def _shadow(shadow: Shadow | None, wanted: Effects) -> Shadow:
    """Return a shadow with an edge unless all light is left, and with stripes.

    The light that is left behind stripes alone is that of the settings, or of `Shadow`.
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
    """Return a camera that sharpens, of which nobody states a linear response then."""
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
