"""What a simulated data set may vary: one frozen, checked value per field."""

from pydantic import BaseModel, ConfigDict, Field


class _SharedOptions(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)

    spp: int = Field(default=16, ge=4, le=1024)
    """Light paths per pixel; 16 leave about 1 % of noise, more in half shadow."""
    motion_scale: float = Field(default=1.0, ge=0, le=1.5)
    """Amplitude of the motion, relative; above 1 parts may leave the picture or pass through each other."""


class DatasetOptions(_SharedOptions):
    """Options of a data set with cameras all around; the defaults are the numbers of the DeVRF paper."""

    static_views: int = Field(default=100, ge=3, le=2000)
    """Training pictures of the scene at rest, random on the upper hemisphere."""
    static_test_views: int = Field(default=10, ge=1, le=500)
    """Test pictures of the scene at rest."""
    times: int = Field(default=50, ge=2, le=2000)
    """Times of the moving scene, evenly from 0 (at rest) to 1."""
    test_views_per_time: int = Field(default=2, ge=1, le=50)
    """Test pictures of the moving scene at every time, each from a random place of its own."""


class ForwardOptions(_SharedOptions):
    """Options of a data set whose cameras all look the same way at a wall."""

    static_views: int = Field(default=30, ge=3, le=2000)
    """Pictures of the sweep of the scene at rest, without the fixed cameras' own."""
    times: int = Field(default=40, ge=2, le=2000)
    """Times of the moving scene, evenly from 0 (at rest) to 1."""
    spread: float = Field(default=0.8, ge=0.2, le=1.5)
    """Width of the region that the cameras stand in, world units; its height is 0.6 of it."""
