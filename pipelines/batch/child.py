"""`devrf.pipelines.batch.child PARENT run SCENE …`: devrf-pipeline, told to end when its parent has ended.

A batch that is killed, or a node whose scheduler dies, must not leave runs behind that hold their folders.
"""

import signal
import sys

from devrf.capture.processes import die_with_parent


def main() -> None:
    """Run the command line in the words after the parent's process number."""
    die_with_parent(int(sys.argv[1]), signal.SIGTERM)
    sys.argv = ["devrf-pipeline", *sys.argv[2:]]
    from devrf.pipelines.cli import main as devrf_pipeline

    devrf_pipeline()


if __name__ == "__main__":
    main()
