#!/usr/bin/env bash
# The published recipe in full, the other presets beside it, and its ablation at half size, on a GPU; then one table of
# all scenes. Meant for nine minutes: no part of the ablation begins later.
#
#   benchmarks/gpu.sh SCENE [options of `devrf-pipeline bench`, such as --device cpu --set reconstruct.rays=256]
#
# RUN=FOLDER: a finished run, on which the viewer is measured too (needs viser).
# SCENE is a scene.yaml (or its folder) that names a data set. Needs torch, numpy, scipy, pydantic, pyyaml, typer, rich,
# jaxtyping, safetensors, Pillow and Warp; no OpenCV, PyAV or pycolmap where the data set brings its flow.
set -euo pipefail
MINUTES=9
cd "$(dirname "${BASH_SOURCE[0]}")/.."
scene=${1:?usage: benchmarks/gpu.sh SCENE [options]}
shift
python=${PYTHON:-$([ -x .venv/bin/python ] && echo .venv/bin/python || echo python3)}
"$python" -c 'import devrf.pipelines' 2>/dev/null \
  || "$python" -m pip install --quiet --no-deps --no-build-isolation -e .
[ -d "$scene" ] && scene="$scene/scene.yaml"
name=$("$python" -c 'import sys, yaml; print(yaml.safe_load(open(sys.argv[1]))["name"])' "$scene")
results=${RESULTS:-benchmarks/results}
bench() {
  "$python" -m devrf.pipelines.cli bench "$1" "$scene" --device cuda --out "runs/gpu-$name" "${@:2}"
}
bench reference --minutes 0 --json "$results/reference-$name.json" "$@"
bench speed --preset reference --json "$results/speed-$name.json" "$@" # takes the training before for `reference`
left=$((SECONDS < 60 * MINUTES ? 60 * MINUTES - SECONDS : 0))
bench reference --minutes $((left / 60)) --json "$results/reference-$name.json" "$@"
[ -z "${RUN:-}" ] || "$python" -m benchmarks.viewer "$RUN" --device cuda --json "$results/viewer-$name.json"
"$python" benchmarks/merge.py "$results"
