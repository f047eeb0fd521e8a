"""`devrf.pipelines.batch.child PARENT run SCENE …`: devrf-pipeline, told to end when its parent has ended.

A batch that is killed, or a node whose scheduler dies, must not leave runs behind that hold their folders.
"""

import runpy
import signal
import sys

from devrf.capture.system.processes import die_with_parent


def main() -> None:
    """Run the command line in the words after the parent's process number."""
    die_with_parent(int(sys.argv[1]), signal.SIGTERM)
    sys.argv = ["devrf-pipeline", *sys.argv[2:]]
    runpy.run_module("devrf", run_name="__main__")


if __name__ == "__main__":
    main()
