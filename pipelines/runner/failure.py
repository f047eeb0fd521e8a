"""What is said when a stage fails, which error it is, and the exit code."""

import errno
import logging
import traceback

from devrf.capture.errors import DevrfError, HealthError, OutOfTime
from devrf.pipelines.disk_told import refused_by_system
from devrf.pipelines.exit_codes import FAILED, UNHEALTHY
from devrf.pipelines.logs import LOG_FILE
from devrf.pipelines.runner.run import Run
from devrf.pipelines.runner.workspace import disk_full_message, is_disk_full
from devrf.pipelines.stage import Stage

NO_ROOM = 1_000_000  # bytes: with less than this free, a failure to write is a full disk whatever it says
NO_MEMORY = (
    "out of memory",
    "allocate memory",
    "bad_alloc",
    "bad allocation",
    "insufficient memory",
    "start new thread",  # which needs memory for its stack
)  # messages

logger = logging.getLogger(__name__)


def explain(
    run: Run, stage: Stage, error: BaseException, written: int, free: int | None
) -> tuple[int, str, str]:
    """Exit code, the error's code and message of a stage's failure; the trace goes to the log."""
    name = stage.name
    if isinstance(error, OutOfTime):
        what = f"{name}: {error} (budget.time_minutes); run again to go on, or give it more time"
        return FAILED, error.code, what
    trace = "".join(traceback.format_exception(error))
    logger.debug("%s", trace)
    if is_disk_full(error) or (free is not None and free < NO_ROOM and not isinstance(error, HealthError)):
        return FAILED, "disk-full", f"{name}: {disk_full_message(run.run_dir, name, written)}"
    if isinstance(error, DevrfError):
        return UNHEALTHY if isinstance(error, HealthError) else FAILED, error.code, f"{name}: {error}"
    if is_no_memory(error):
        budget, on_gpu = run.config.budget.gpu_memory_gb, not isinstance(error, MemoryError)
        bounded = budget is not None and run.device == "cuda" and on_gpu
        remedy = f"raise budget.gpu_memory_gb ({budget:g})" if bounded else "close other programs"
        what = f"{name}: not enough memory ({first_line(error)}); {remedy}, or use --preset tiny, or lower "
        return (
            FAILED,
            "no-memory",
            what + "reconstruct.image_scale, reconstruct.rays or reconstruct.resolution",
        )
    if isinstance(error, SystemExit):
        what = f"{name}: a library ended the program (exit {error.code}); see devrf.log in {run.run_dir}"
        return FAILED, "library-ended-program", what
    refused = refused_by_system(error, run.run_dir)
    if refused is not None:
        return FAILED, refused.code, f"{name}: {refused}: finished stages are kept"
    if run.talk.loudness == "verbose":
        run.talk.err.print(trace, markup=False)
    return FAILED, "unexpected", f"{name}: {unexpected(run, error)}"


def unexpected(run: Run, error: BaseException) -> str:
    """What is said of an error that nobody foresaw."""
    return (
        f"unexpected {type(error).__name__}: {error}. This is a fault of the program, not of your files; the whole "
        f"trace is in {run.run_dir / LOG_FILE}"
    )


def is_no_memory(error: BaseException) -> bool:
    """Whether an error says that memory has run out, in Python's words or a library's."""
    if isinstance(error, OSError) and error.errno == errno.ENOMEM:
        return True
    return isinstance(error, MemoryError) or any(words in str(error).lower() for words in NO_MEMORY)


def first_line(error: BaseException) -> str:
    """The first line of its text; where there is none, its kind."""
    return str(error).splitlines()[0] if str(error) else type(error).__name__
