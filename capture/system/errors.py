"""Errors that a user can act on: each names the thing, the value, the expectation and the remedy.

The runner turns them into exit codes (docs/conventions.md): `InputError` seen before anything was
started is 2, `HealthError` is 3, every other `DevrfError` raised while a stage runs is 1.
"""


class DevrfError(Exception):
    """Base of every error that is the data's or the configuration's fault, not the program's.

    Args:
        code: Which error it is, for programs and tests: one to four words joined by hyphens (`rig-unlinked-camera`). It
            stays as it is when the text is put in other words.
        text: For people: the thing, the value, what was expected, what to do.
    """

    def __init__(self, code: str, text: str) -> None:
        super().__init__(code, text)  # both, so that it survives the way out of a worker process
        self.code, self.text = code, text

    def __str__(self) -> str:
        return self.text


class InputError(DevrfError):
    """Bad configuration or input: missing file, unknown key, not a video."""


class CaptureError(DevrfError):
    """Raw material that cannot be read or used."""


class CalibrationError(DevrfError):
    """Cameras or clocks that cannot be recovered."""


class FlowError(DevrfError):
    """Optical flow that cannot be computed or read."""


class ReconstructError(DevrfError):
    """A model that cannot be trained, loaded or rendered."""


class OutOfTime(DevrfError):
    """Work that ends because its time is over, and goes on from there when it is begun again."""


class HealthError(DevrfError):
    """A stage's own check refused its result (board never seen, sweep not registered, ...)."""
