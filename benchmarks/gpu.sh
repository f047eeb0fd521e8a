#!/usr/bin/env bash
# The presets in full, beside each other, then the published recipe's ablation at half size, on a GPU.
#
#   benchmarks/gpu.sh SCENE [options of `devrf-pipeline bench`, such as --device cpu --set reconstruct.rays=256]
#
# RUN=FOLDER: a finished run, on which the viewer is measured too (needs viser).
# SCENE is a scene.yaml (or its folder) that names a data set. Needs torch, numpy, scipy, pydantic, pyyaml, typer, rich,
# jaxtyping, safetensors, Pillow and Warp; no OpenCV, PyAV or pycolmap where the data set brings its flow.
set -euo pipefail
HALF=(image_scale=0.5 resolution=80 rays=4096 canonical_iterations=5000 motion_iterations=500)
cd "$(dirname "${BASH_SOURCE[0]}")/.."
scene=${1:?usage: benchmarks/gpu.sh SCENE [options]}
shift
python=${PYTHON:-$([ -x .venv/bin/python ] && echo .venv/bin/python || echo python3)}
"$python" -c 'import devrf.lab' 2>/dev/null \
  || "$python" -m pip install --quiet --no-deps --no-build-isolation -e .
[ -d "$scene" ] && scene="$scene/scene.yaml"
name=$("$python" -c 'import sys, yaml; print(yaml.safe_load(open(sys.argv[1]))["name"])' "$scene")
results=${RESULTS:-benchmarks/results}
bench() {
  "$python" -m devrf.pipelines.cli.main bench "$1" "$scene" --preset reference --device cuda \
    --out "runs/gpu-$name/$1" --json "$results/$1-$name.json" "${@:2}"
}
bench speed "$@"
bench ablation "${HALF[@]/#/--set=reconstruct.}" "$@"
[ -z "${RUN:-}" ] || "$python" -m benchmarks.viewer "$RUN" --device cuda --json "$results/viewer-$name.json"
