"""What is said when a stage fails, which error it is, and the exit code."""

import errno
import logging
import traceback

from devrf.capture.system.errors import DevrfError, HealthError, OutOfTime
from devrf.pipelines.run_folder.workspace import disk_full_message, is_disk_full
from devrf.pipelines.runner.run_state import Run
from devrf.pipelines.stage import Stage
from devrf.pipelines.terminal.disk_errors import refused_by_system
from devrf.pipelines.terminal.exit_codes import FAILED, UNHEALTHY
from devrf.pipelines.terminal.logs import LOG_FILE

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
    run: Run, stage: Stage | None, error: BaseException, written: int, free: int | None
) -> tuple[int, str, str]:
    """Exit code, the error's code and message of a failure, of a stage or between two; the trace goes to the log.

    Args:
        run: The run.
        stage: The stage; None between two.
        error: What went wrong.
        written: Bytes that the stage had written.
        free: Bytes that are free on the disk, where that is known.
    """
    before, what = ("", "the run") if stage is None else (f"{stage.name}: ", stage.name)
    if isinstance(error, OutOfTime):
        text = f"{before}{error} (budget.time_minutes); run again to go on, or give it more time"
        return FAILED, error.code, text
    trace = "".join(traceback.format_exception(error))
    logger.debug("%s", trace)
    if is_disk_full(error) or (free is not None and free < NO_ROOM and not isinstance(error, HealthError)):
        return FAILED, "disk-full", before + disk_full_message(run.run_dir, what, written)
    if isinstance(error, DevrfError):
        return UNHEALTHY if isinstance(error, HealthError) else FAILED, error.code, f"{before}{error}"
    if is_no_memory(error):
        budget, on_gpu = run.config.budget.gpu_memory_gb, not isinstance(error, MemoryError)
        bounded = budget is not None and run.device == "cuda" and on_gpu
        remedy = f"raise budget.gpu_memory_gb ({budget:g})" if bounded else "close other programs"
        text = (
            f"{before}not enough memory ({first_line(error)}); {remedy}, or use --preset tiny, or lower "
            "reconstruct.image_scale, reconstruct.rays or reconstruct.resolution"
        )
        return FAILED, "no-memory", text
    if isinstance(error, SystemExit):
        text = f"{before}a library ended the program (exit {error.code}); see devrf.log in {run.run_dir}"
        return FAILED, "library-ended-program", text
    refused = refused_by_system(error, run.run_dir)
    if refused is not None:
        return FAILED, refused.code, f"{before}{refused}: finished stages are kept"
    if stage is not None and run.talk.loudness == "verbose":
        run.talk.err.print(trace, markup=False)
    text = (
        f"{before}unexpected {type(error).__name__}: {error}. This is a fault of the program, not of your files; the "
        f"whole trace is in {run.run_dir / LOG_FILE}"
    )
    return FAILED, "unexpected", text


def is_no_memory(error: BaseException) -> bool:
    """Whether an error says that memory has run out, in Python's words or a library's."""
    if isinstance(error, OSError) and error.errno == errno.ENOMEM:
        return True
    return isinstance(error, MemoryError) or any(words in str(error).lower() for words in NO_MEMORY)


def first_line(error: BaseException) -> str:
    """The first line of its text; where there is none, its kind."""
    return str(error).splitlines()[0] if str(error) else type(error).__name__
