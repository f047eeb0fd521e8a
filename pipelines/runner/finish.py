"""What the runner adds to a stage's folder: its health, and the stamp that makes it complete."""

import json
import platform
import resource
import secrets
import sys
import time
from pathlib import Path

import devrf
from devrf.capture.system.amounts import GB
from devrf.capture.system.durable import write_json
from devrf.pipelines.runner.run_state import Run
from devrf.pipelines.stage import Stage, StageContext
from devrf.pipelines.stamps.stamp import HEALTH, STAMP, code_of_stage, content_of, files_of


def finish(run: Run, folder: Path, stage: Stage, context: StageContext, seconds: float) -> None:
    """Write health and, last of all, the stamp that makes the folder complete."""
    write_json(folder / HEALTH, {"stage": stage.name, "rows": [row.as_dict() for row in context.health]})
    files = files_of(folder, run.digests)
    referred = run.digests.of_files(context.referred)
    stamp = {
        "id": secrets.token_hex(8),
        "stage": stage.name,
        "content": content_of(folder, files, context.made_from["places"], referred),
        "identity": json.loads(json.dumps(context.made_from)),
        "version": devrf.__version__,
        "made_with": {
            "python": platform.python_version(),
            "device": run.device,
            **code_of_stage(stage, run.config).libraries,
        },
        "run": run.name,
        "finished": time.strftime("%Y-%m-%d %H:%M:%S"),
        "seconds": round(seconds, 3),
        "peak_rss_gb": round(_peak_rss_gb(), 3),
        "files": files,
    }
    write_json(folder / STAMP, stamp)


def _peak_rss_gb() -> float:
    """Largest resident memory of this process or of one of its children so far, GB."""
    kilobytes = max(
        resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    return kilobytes * (1024 if sys.platform != "darwin" else 1) / GB
