#!/usr/bin/env bash
# The stability suite on a GPU: every axis at two severities, one seed. Meant for 25 minutes: no case begins after 23, and
# what there is by then is written. Called again with the same OUT it goes on where it was.
#
#   benchmarks/gpu_stability.sh [SCENE] [options of `devrf-pipeline bench stability`, such as --axes flow --device cpu]
#
# SCENE is a scene.yaml (or its folder) with test cameras: a session that was rendered before, such as
# bench-stability/session, where Mitsuba is not installed; axes that would render it again are then left out and named.
# It is trained at the size of the small session (`SETTINGS` of lab/bench/stability/small_session.py); --set changes that.
# Without SCENE that session is rendered first (extra `simulate`).
set -euo pipefail
MINUTES=${MINUTES:-23}
cd "$(dirname "${BASH_SOURCE[0]}")/.."
python=${PYTHON:-$([ -x .venv/bin/python ] && echo .venv/bin/python || echo python3)}
"$python" -c 'import devrf.lab' 2>/dev/null \
  || "$python" -m pip install --quiet --no-deps --no-build-isolation -e .
scene=()
if [ $# -gt 0 ] && [ "${1#-}" = "$1" ]; then
  scene=("$1" $("$python" -c '
from devrf.lab.bench.stability.small_session import SETTINGS
print(*(f"--set {setting}" for setting in SETTINGS))'))
  [ -d "$1" ] && scene[0]="$1/scene.yaml"
  shift
fi
results=${RESULTS:-benchmarks/results}
"$python" -m devrf.pipelines.cli.main bench stability "${scene[@]}" --device cuda --severities 2 --minutes "$MINUTES" \
  --out "${OUT:-runs/gpu-stability}" --json "$results/stability-gpu.json" "$@"
