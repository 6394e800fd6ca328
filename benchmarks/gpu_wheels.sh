#!/usr/bin/env bash
# Fill the folder wheels/ with what a machine lacks that has PyTorch and its usual company but no network.
#   sh benchmarks/gpu_wheels.sh [FOLDER]      Python 3.12 on x86-64 Linux; other machines: set PYTHON_VERSION
# The program itself is not among them: benchmarks/gpu_run.sh runs it from the checkout.
set -euo pipefail
cd "$(dirname "$0")/.."
folder=${1:-wheels}
python=$([ -x .venv/bin/python ] && echo .venv/bin/python || echo python3)

# What lidargrit imports beyond torch, NumPy, SciPy, safetensors, jaxtyping, rich, matplotlib and Pillow.
packages=(embreex lightning-fabric)
platforms=()
for glibc in 2_28 2_27 2_17; do platforms+=(--platform "manylinux_${glibc}_x86_64"); done

rm -rf "$folder"
"$python" -m pip download --quiet --no-deps --only-binary=:all: --implementation cp --python-version "${PYTHON_VERSION:-3.12}" \
    "${platforms[@]}" --platform manylinux2014_x86_64 --constraint constraints.txt --dest "$folder" "${packages[@]}"
du -sh "$folder"
