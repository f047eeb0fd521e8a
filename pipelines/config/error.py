"""Everything that is wrong with a configuration, at once."""

from collections.abc import Iterable

from devrf.capture.system.errors import InputError


class ConfigError(InputError):
    """Everything that is wrong with a configuration; one line per mistake in `mistakes`."""

    def __init__(self, mistakes: Iterable[str]) -> None:
        self.mistakes = tuple(dict.fromkeys(mistakes))
        super().__init__("configuration", "\n".join(self.mistakes))

    def __reduce__(self) -> tuple[type["ConfigError"], tuple[tuple[str, ...]]]:
        return type(self), (self.mistakes,)
