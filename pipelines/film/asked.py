"""What a user asks of a film, and which of the options can go together."""

import re
from dataclasses import dataclass, fields
from pathlib import Path

from devrf.capture.errors import InputError

LAYERS = ("colour", "depth", "flow")
FORMATS = ("mp4", "png", "webp")
SIDE_PX = (16, 8192)  # least and most of a picture
FPS = (0.1, 240.0)
USUAL_FPS = 24.0
USUAL_SLOW = 0.25  # speed between the times of --slow, where none is named
RUNNING = ("speed", "slow", "begin", "end", "ping_pong")  # what is about time that runs
OPTION = {"begin": "from", "end": "to"}  # where the option has another name: these two are words of Python


def option(key: str) -> str:
    """The option's name on the command line."""
    return "--" + OPTION.get(key, key).replace("_", "-")


@dataclass(frozen=True)
class Asked:
    """The options of a film as typed; what was not asked for is None."""

    path: str | None = None
    seconds: float | None = None
    fps: float | None = None
    speed: float | None = None
    slow: str | None = None
    time: str | None = None
    begin: str | None = None
    end: str | None = None
    ping_pong: bool | None = None
    size: str | None = None
    layers: str | None = None
    beside: str | None = None
    without: str | None = None
    format: str | None = None
    out: Path | None = None

    @property
    def nothing(self) -> bool:
        """Whether no option was given."""
        return not self._given()

    @property
    def name(self) -> str:
        """A name for the film's folder that other options do not give."""
        words = [Path(self.path).stem if self.path and self.path.endswith(".json") else self.path or "orbit"]
        for key, value in self._given().items():
            if key not in ("path", "out"):
                words += [option(key)[2:]] + (
                    [] if value is True else [f"{value:g}" if isinstance(value, float) else str(value)]
                )
        return re.sub(r"[^\w.+-]+", "-", "-".join(words)).strip("-.")[:120] or "film"

    @property
    def running(self) -> list[str]:
        """The options given that are about time that runs."""
        return [key for key in RUNNING if key in self._given()]

    def check(self) -> None:
        """Refuse what is no film, or two ways of time at once.

        Raises:
            InputError: With the option, its value and what is expected.
        """
        for key, low, high in (("seconds", 0.0, 3600.0), ("fps", *FPS), ("speed", 0.001, 1000.0)):
            value = getattr(self, key)
            if value is not None and not low <= value <= high or value == 0:
                least = "more than 0" if low == 0 else f"at least {low:g}"
                text = f"--{key} {value:g}: expected {least} and at most {high:g}"
                raise InputError("option-out-of-range", text)
        running = self.running
        if self.time is not None and running:
            others = ", ".join(map(option, running))
            text = f"--time {self.time}: time stands still, which {others} cannot change; leave one out"
            raise InputError("option-misplaced", text)
        self.size_px()
        self.layer_names()
        if (self.format or "mp4") not in FORMATS:
            raise InputError("option-unknown-value", f"--format {self.format}: expected {', '.join(FORMATS)}")
        if self.beside is not None and self.layer_names() != ("colour",):
            text = f"--beside {self.beside}: true pictures have no {self.layers}; leave out --layers"
            raise InputError("option-misplaced", text)

    def size_px(self) -> tuple[int, int] | None:
        """Width and height.

        Raises:
            InputError: Not a size, or one that cannot be made.
        """
        if self.size is None:
            return None
        match = re.fullmatch(r"(\d{1,6})x(\d{1,6})", self.size.strip())
        if match is None:
            text = f"--size {self.size}: expected WIDTHxHEIGHT, such as 640x360"
            raise InputError("option-malformed", text)
        width, height = int(match[1]), int(match[2])
        least, most = SIDE_PX
        if not (least <= width <= most and least <= height <= most):
            text = f"--size {self.size}: expected sides of {least} to {most} pixels"
            raise InputError("option-out-of-range", text)
        if (self.format or "mp4") == "mp4" and (width % 2 or height % 2):
            raise InputError(
                "film-sides-odd",
                f"--size {self.size}: H.264 needs even sides; take {width - width % 2}x{height - height % 2}, or "
                "--format png",
            )
        return width, height

    def layer_names(self) -> tuple[str, ...]:
        """The layers, in the order of `LAYERS`.

        Raises:
            InputError: One of them is unknown.
        """
        if self.layers is None:
            return ("colour",)
        asked = {word.strip() for word in self.layers.split(",")}
        unknown = sorted(asked - set(LAYERS))
        if unknown:
            text = f"--layers {self.layers}: expected some of {','.join(LAYERS)}"
            raise InputError("option-unknown-value", text)
        return tuple(layer for layer in LAYERS if layer in asked)

    def left_out(self) -> tuple[int, ...]:
        """Rigid parts that are not shown, counted from 1.

        Raises:
            InputError: Not numbers.
        """
        words = [] if self.without is None else [word.strip() for word in self.without.split(",")]
        if not all(re.fullmatch(r"0*[1-9]\d{0,2}", word) for word in words):
            text = f"--without {self.without}: expected numbers of parts, such as 2 or 1,3 (the report lists them)"
            raise InputError("option-malformed", text)
        return tuple(sorted({int(word) for word in words}))

    def slow_texts(self) -> tuple[str, str] | None:
        """The two times of --slow.

        Raises:
            InputError: Not two times.
        """
        if self.slow is None:
            return None
        words = self.slow.split(",")
        if len(words) != 2:
            text = f"--slow {self.slow}: expected two times, such as 0.4,0.6 or 1.0s,1.5s"
            raise InputError("option-malformed", text)
        return words[0], words[1]

    def _given(self) -> dict[str, object]:
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {key: value for key, value in values.items() if value is not None and value is not False}
