"""`python -m devrf.pipelines.batch.child PARENT run SCENE …`: devrf-pipeline, which ends when its parent does.

A batch that is killed, or a node whose scheduler dies, must not leave runs behind that hold their folders.
"""

import ctypes
import os
import signal
import sys

PR_SET_PDEATHSIG = 1  # linux/prctl.h


def main() -> None:
    """Run the command line in the words after the parent's process number."""
    end_with_parent(int(sys.argv[1]))
    sys.argv = ["devrf-pipeline", *sys.argv[2:]]
    from devrf.pipelines.cli import main as devrf_pipeline

    devrf_pipeline()


def end_with_parent(parent: int) -> None:
    """Ask the kernel for SIGTERM when the parent ends. Only Linux can do that; elsewhere nothing happens."""
    if sys.platform != "linux":
        return
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:  # it ended before we asked
        sys.exit(128 + signal.SIGTERM)


if __name__ == "__main__":
    main()
