#!/bin/sh
# Installs this project with the extras that are named into .venv: sh install.sh dev. Called by make.
# PyPI's torch for Linux brings 3 GB for NVIDIA GPUs; PyTorch's own index has a build for CPUs of a fifteenth of it.
set -eu

extras=$1
python=.venv/bin/python
cpu_builds=https://download.pytorch.org/whl/cpu

has_torch() { "$python" -c "import importlib.util, sys; sys.exit(importlib.util.find_spec('torch') is None)"; }
reachable() {
    "$python" -c "import sys, urllib.request; urllib.request.urlopen(sys.argv[1] + '/torch/', timeout=5)" "$cpu_builds" 2>/dev/null
}

set -- -c constraints.txt -e ".[$extras]"
if [ "$(uname -s)" = Linux ] && ! command -v nvidia-smi >/dev/null 2>&1 && ! has_torch; then
    if reachable; then
        echo "No NVIDIA GPU here: installing PyTorch's build for CPUs. About 0.5 GB to download in all, 1.8 GB on disk."
        set -- --extra-index-url "$cpu_builds" "$@"
    else
        echo "$cpu_builds does not answer: installing the torch that pip finds. If it is PyPI's, about 3 GB to download."
    fi
fi
"$python" -m pip install --disable-pip-version-check --progress-bar on "$@"
