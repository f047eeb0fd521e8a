"""Where `render` and `export` write what they take out of a run."""

from pathlib import Path

from devrf.capture.formats.parts.export import check_target
from devrf.pipelines.run_folder.own_folder import check_run_folder


def output_folder(run_dir: Path, out: Path | None, usual: str, kind: str) -> Path:
    """The folder that a command writes what it takes out of a run, before anything is made.

    Args:
        run_dir: The run folder.
        out: As it was named; None: `usual` in the run folder.
        usual: Relative to the run folder.
        kind: Of folders that may be replaced (`check_target`).
    Raises:
        InputError: It holds something else, cannot be written, or lies behind a link in the run folder.
    """
    if out is None:
        check_run_folder(run_dir, ())
    folder = run_dir / usual if out is None else out.expanduser().resolve()
    check_target(folder, kind)
    return folder
