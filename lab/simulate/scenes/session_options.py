"""What a simulated session may vary: one frozen, checked value per field."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class SessionOptions(BaseModel):
    """Options of a simulated session; every one has a default that gives a good small session."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)

    sweep_frames: int = Field(default=72, ge=2, le=2000)
    """Pictures of the sweep: two rings at two heights and, last, an arc before the board."""
    sweep_fps: float = Field(default=4.0, gt=0, le=120)
    """Frame rate of the sweep's video, hertz."""
    sweep_radius_m: float = Field(default=1.5, gt=0.8, le=1.75)
    """Distance of the sweep's path from the middle of the room."""
    sweep_aim_m: float = Field(default=0.95, ge=0.2, le=2)
    """Height at which the sweep's high ring, at 1.6 m, looks in the middle of the room: what stands behind, too, from
    about 1.3 on."""
    fps: float = Field(default=16.0, gt=0, le=240)
    """Frame rate of the fixed cameras, hertz."""
    sweep_motion: float = Field(default=0.0, ge=0, le=1)
    """Share of its motion that the object makes already while the sweep is taken; at 0 it rests."""
    other_fps: float = Field(default=0.0, ge=0, le=240)
    """Frame rate of every second fixed camera, hertz; 0: that of the others."""
    portrait: bool = False
    """Whether the last fixed camera before the witness is held upright."""
    duration_s: float = Field(default=2.7, gt=0.1, le=600)
    """Length of every fixed camera's clip."""
    pts_jitter_ms: float = Field(default=0.0, ge=0, le=20)
    """Largest deviation of a frame's time from an even rate (variable frame rate), milliseconds."""
    rest_s: float = Field(default=0.3, ge=0, le=60)
    """The object moves after this time on cam0's clock."""
    motion_scale: float = Field(default=1.0, ge=0, le=3)
    """Amplitude of the motion, relative."""
    motion_speed: float = Field(default=1.0, gt=0, le=10)
    """Speed of the motion, relative."""
    spread_deg: float = Field(default=130.0, ge=0, le=180)
    """Angle around the object between the first and the last fixed camera, degrees."""
    fan_deg: float = Field(default=0.0, ge=-90, le=90)
    """Azimuth of the fixed cameras' middle, degrees; the witness stays where it is at 0."""
    camera_distance_m: float = Field(default=1.65, ge=1.0, le=1.8)
    """Distance of the fixed cameras from where the hands clap, before jitter."""
    offset_range_s: float = Field(default=0.15, ge=0, le=10)
    """Clips start within this time before or after cam0's, to a fraction of a frame."""
    drift_range_ppm: float = Field(default=60.0, ge=0, le=5000)
    """Largest deviation of a clock from cam0's rate, parts per million."""
    k1: float = Field(default=-0.06, ge=-0.2, le=0.2)
    """First radial distortion coefficient, before jitter of 20 %."""
    gain_range: float = Field(default=0.06, ge=0, le=0.9)
    """Largest deviation of a camera's exposure from the sweep's, relative, in linear light."""
    exposure_s: float = Field(default=0.0, ge=0, le=0.1)
    """Exposure of the fixed cameras' pictures, seconds: what moves is blurred along its way; 0: not at all."""
    sway_m: float = Field(default=0.0, ge=0, le=0.1)
    """How far the object's top sways while the sweep is taken, metres, as someone who stands still does."""
    noise: float = Field(default=0.006, ge=0, le=0.2)
    """Standard deviation of the sensor's noise at mid grey, relative to full scale."""
    room: Literal["patterned", "shelves", "window", "narrow", "workshop"] = "patterned"
    """What stands round the object: patterned walls and boxes; plain walls and furniture: shelves, a window behind
    the object, or a narrow room whose fixed cameras stand close to things; or a workshop in daylight, with a bench."""
    texture_contrast: float = Field(default=1.0, ge=0, le=1.5)
    """Contrast of all textures of the room and of the object; 0 gives blank walls."""
    strip_m: float = Field(default=0.0, ge=0, le=0.2)
    """Width of the strips that the sheet is cut into, metres, with gaps as wide; 0 leaves it whole."""
    change: Literal["appear", "part", "tumble"] = "appear"
    """What the object `changing` does: a ball grows out of nothing, a block splits in two, or one turns over."""
    gloss: float = Field(default=0.0, ge=0, le=1)
    """Share of the light that the object mirrors, as lacquer does."""
    clear: float = Field(default=0.0, ge=0, le=1)
    """Share of the light from behind that the object lets through, as gauze does."""
    lamp_travel_m: float = Field(default=0.0, ge=0, le=3)
    """Way of the lamp above the room while the object moves, metres: shadows move."""
    background_motion_m: float = Field(default=0.0, ge=0, le=1.2)
    """How far the two boxes behind the object move sideways and back while it moves, metres."""
    spp: int = Field(default=8, ge=4, le=1024)
    """Light paths per pixel; 8 leave about 1 % of noise, well below the sensor's."""
    crf: int = Field(default=17, ge=0, le=51)
    """Quality of the H.264 pictures: 0 is lossless, 17 is very good, 35 is poor."""
    claps: int = Field(default=5, ge=0, le=100)
    """Claps at irregular times within what all cameras record."""
    sound: bool = True
    """Whether the clips carry sound at all."""
    board: bool = True
    """Whether there is a ChArUco board: a clip per camera, and standing in the room."""
    board_frames: int = Field(default=18, ge=4, le=500)
    """Pictures of every board clip."""
