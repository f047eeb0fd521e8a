"""Removing folders, where a signal may come at any time."""

import shutil
from pathlib import Path


def remove_tree(folder: Path) -> None:
    """Remove a folder with all that is in it; what cannot be removed stays.

    Raises:
        KeyboardInterrupt: A signal came meanwhile.
    """
    try:
        shutil.rmtree(folder, ignore_errors=True)
    except OSError as error:
        # rmtree closes a folder again if a signal comes right after it has closed it, and this error hides the signal
        if isinstance(error.__context__, KeyboardInterrupt):
            raise error.__context__ from None
        raise
