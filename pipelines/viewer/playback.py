"""Which moment is shown: a place in the clip that stands, or runs with the clock, faster or slower, there and back."""

from dataclasses import dataclass


@dataclass
class Playback:
    """A place in a clip.

    Attributes:
        span_s: Length of the clip.
        speed: Seconds of the clip in a second.
        ping_pong: Back again from the end, instead of once more from the beginning.
    """

    span_s: float
    speed: float = 1.0
    ping_pong: bool = False
    _way_s: float = 0.0  # passed since the beginning, there and back
    _since: float | None = None  # on the clock; None: it stands

    @property
    def runs(self) -> bool:
        """Whether it runs."""
        return self._since is not None

    def place(self, now: float) -> float:
        """Share of the clip in [0, 1] at a moment of the clock, seconds."""
        way = self._passed(now) / self.span_s
        if not self.ping_pong:
            return way % 1 if self.runs or way > 1 else way
        way %= 2
        return way if way <= 1 else 2 - way

    def go(self, now: float) -> None:
        """Run from where it is; from the beginning where it is at the end."""
        if not self.runs:
            at_end = not self.ping_pong and self._way_s >= self.span_s
            self._way_s, self._since = 0.0 if at_end else self._way_s, now

    def stop(self, now: float) -> None:
        """Stay where it is."""
        self.jump(self.place(now))

    def jump(self, place: float) -> None:
        """Stand at a share of the clip."""
        self._way_s, self._since = place * self.span_s, None

    def retime(self, now: float, speed: float, ping_pong: bool) -> None:
        """Another speed and way from now on, from the place where it is."""
        runs, place = self.runs, self.place(now)
        self.jump(place)
        self.speed, self.ping_pong = speed, ping_pong
        if runs:
            self.go(now)

    def _passed(self, now: float) -> float:
        return self._way_s + (0.0 if self._since is None else self.speed * (now - self._since))
