"""Settings of a simulated flight, and the presets by name."""

from __future__ import annotations

from dataclasses import dataclass, replace

from kgcp.errors import SettingError
from kgcp.geometry.camera import Camera, Response
from kgcp.settings import require_range
from kgcp.simulation.imaging import Sensor, ToneCurve
from kgcp.simulation.light_settings import Dirt, Glare, Shadow
from kgcp.simulation.phone import Demosaicing, Phone
from kgcp.simulation.point_spread import Aberration
from kgcp.simulation.rolling_shutter import ImageMotion

_CAMERA = Camera(
    width=1600,
    height=1200,
    fx=2306.0,
    fy=2302.0,
    cx=792.6,
    cy=603.9,
    k1=-0.072,
    k2=0.055,
    p1=0.0004,
    p2=-0.0003,
    response=Response.LINEAR,
)
_SENSOR = Sensor()
_MOTION = ImageMotion()


@dataclass(frozen=True, slots=True)
class SimulationSettings:
    """Parameters of a simulated flight. Pairs are ranges."""

    name: str  # name of the flight
    camera: Camera = _CAMERA
    sensor: Sensor = _SENSOR
    frames: int = 60  # number of frames
    # camera to target; the UAV climbs and descends between the two, uniform in the logarithm
    distance_m: tuple[float, float] = (8.0, 110.0)
    tilt_deg: tuple[float, float] = (0.0, 12.0)  # optical axis against the vertical, uniform [deg]
    # exposure relative to the one at which radiance 1 fills the well, uniform in the logarithm
    gain: tuple[float, float] = (0.7, 1.0)
    psf_px: tuple[float, float] = (0.55, 0.75)  # σ of the point spread, uniform [px]
    # length of the motion streak, uniform, in any direction [px]
    streak_px: tuple[float, float] = (0.0, 0.0)
    # light on the plates that is not the same everywhere; None: none of the kind
    shadow: Shadow | None = None
    dirt: Dirt | None = None
    glare: Glare | None = None
    lens: Aberration | None = None  # None: the point spread is a round Gaussian
    phone: Phone | None = None  # None: grey values are what the `sensor` makes of the light
    # while rows are read: without effect if the camera's `readout_s` is 0
    motion: ImageMotion = _MOTION
    # share of frames without the target, and with a plate of another code where there is room
    absent_share: float = 0.1
    decoy_share: float = 0.2
    jpeg_quality: int | None = None  # None: PNG
    # errors of the trajectory: map x, y, z [m]; roll, pitch, heading [deg]
    sd_position_m: tuple[float, float, float] = (0.010, 0.010, 0.018)
    sd_attitude_deg: tuple[float, float, float] = (0.02, 0.02, 0.05)
    # errors of the lever arm, per axis and flight [m], and of the frames' times [s]
    sd_lever_arm_m: float = 0.003
    sd_time_s: float = 0.001
    # errors of the reference poses, per axis [m, deg]
    sd_reference_m: float = 0.004
    sd_reference_deg: float = 0.003

    def __post_init__(self) -> None:
        require_range("frames", self.frames, 1, 100_000)
        for key, low, high in (
            ("distance_m", 2.0, 1000.0),
            ("tilt_deg", 0.0, 50.0),
            ("gain", 0.01, 100.0),
            ("psf_px", 0.3, 10.0),
            ("streak_px", 0.0, 30.0),
        ):
            first, last = getattr(self, key)
            require_range(key, first, low, high)
            require_range(key, last, first, high)
        for key in ("absent_share", "decoy_share"):
            require_range(key, getattr(self, key), 0.0, 1.0)
        if self.jpeg_quality is not None:
            require_range("jpeg_quality", self.jpeg_quality, 1, 100)

    def without_survey_errors(self) -> SimulationSettings:
        """Return the same flight with perfect trajectory, lever arm, times and reference."""
        return replace(
            self,
            sd_position_m=(0.0, 0.0, 0.0),
            sd_attitude_deg=(0.0, 0.0, 0.0),
            sd_lever_arm_m=0.0,
            sd_time_s=0.0,
            sd_reference_m=0.0,
            sd_reference_deg=0.0,
        )


_UNKNOWN_RESPONSE = replace(_CAMERA, response=Response.UNKNOWN)

# An ordinary camera in real light: the presets below differ from it by one effect each.
_ORDINARY = SimulationSettings(
    name="ordinary",
    camera=_UNKNOWN_RESPONSE,
    sensor=Sensor(tone=ToneCurve.SRGB),
    distance_m=(9.0, 80.0),  # R from 115 down to 13 px
    gain=(0.6, 1.05),
    psf_px=(0.55, 0.95),
    jpeg_quality=93,
)

_PRESETS = (
    SimulationSettings(name="clean", distance_m=(8.0, 129.0)),  # R from 130 down to 8 px
    SimulationSettings(name="exposure_sweep", gain=(0.35, 2.5)),
    SimulationSettings(
        name="consumer",
        camera=_UNKNOWN_RESPONSE,
        sensor=Sensor(tone=ToneCurve.FILM, sharpening=0.6, sharpening_px=1.1),
        gain=(0.5, 1.3),
        psf_px=(0.7, 1.3),
        jpeg_quality=92,
    ),
    SimulationSettings(name="blurred", psf_px=(0.7, 1.4), streak_px=(0.0, 3.0)),
    SimulationSettings(name="oblique", tilt_deg=(20.0, 45.0)),
    SimulationSettings(name="far", distance_m=(80.0, 172.0)),  # R from 13 down to 6 px
    SimulationSettings(
        name="sample",
        camera=Camera(
            width=1200,
            height=900,
            fx=1903.0,
            fy=1901.0,
            cx=606.2,
            cy=446.1,
            k1=-0.081,
            k2=0.064,
            p1=0.0003,
            p2=0.0005,
            response=Response.LINEAR,
        ),
        frames=24,
        distance_m=(9.0, 100.0),
        absent_share=0.125,
        gain=(0.6, 1.05),
        jpeg_quality=94,
    ),
    replace(_ORDINARY, name="shadow", shadow=Shadow()),
    replace(_ORDINARY, name="dirty", dirt=Dirt()),
    replace(_ORDINARY, name="glare", glare=Glare()),
    replace(_ORDINARY, name="lens", lens=Aberration(astigmatism=1.6, coma=0.2)),
    replace(
        _ORDINARY,
        name="phone",
        sensor=Sensor(tone=ToneCurve.SRGB, sharpening=0.8, sharpening_px=1.2),
        phone=Phone(),
    ),
    replace(
        _ORDINARY,
        name="simple_phone",
        sensor=Sensor(tone=ToneCurve.SRGB, sharpening=0.8, sharpening_px=1.2),
        phone=Phone(Demosaicing.NEAREST, bilateral=0.2, local_tone=0.0),
    ),
    replace(
        _ORDINARY,
        name="rolling",
        camera=replace(_UNKNOWN_RESPONSE, readout_s=0.03),
        motion=ImageMotion((160.0, 200.0), sd_px_s=0.0),  # 0.004 and 0.005 px per row
    ),
    replace(
        _ORDINARY,
        name="mixed",
        sensor=Sensor(tone=ToneCurve.SRGB, sharpening=0.3, sharpening_px=1.0),
        shadow=Shadow(light_left=0.7, stripes=1),
        dirt=Dirt(sd=0.02, stains=3),
        lens=Aberration(astigmatism=1.2, coma=0.1),
        phone=Phone(noise_reduction=1.0, local_tone=0.1),
    ),
)

PRESETS = {preset.name: preset for preset in _PRESETS}


def preset(name: str) -> SimulationSettings:
    """Return the settings of a preset.

    Raises
    ------
    SettingError
        For an unknown name.
    """
    if name not in PRESETS:
        raise SettingError("preset", f"{name!r} is unknown", f"give one of {', '.join(PRESETS)}")
    return PRESETS[name]
