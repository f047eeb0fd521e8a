"""Exit codes of the commands; a contract.

0 done; 1 a stage failed; 2 bad configuration or input seen before anything was started; 3 a health check refused a
result; 130 stopped by the user.
"""

from devrf.capture.system.errors import DevrfError, InputError

DONE, FAILED, BAD_INPUT, UNHEALTHY, STOPPED = 0, 1, 2, 3, 130


def code_of(error: DevrfError) -> int:
    """The code of a command that an error ends."""
    return BAD_INPUT if isinstance(error, InputError) else FAILED
