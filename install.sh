#!/bin/sh
# Installs this project with the extras that are named into .venv: sh install.sh dev. Called by make.
# PyPI's torch for Linux brings 2.7 GB for NVIDIA GPUs; PyTorch's own index has a build for CPUs of 0.2 GB.
# Where uv is installed, it does the work: it resolves in seconds and downloads many files at once. It does not know of
# indexes, mirrors and certificates that pip is configured with, so there, and wherever it fails, pip does the work.
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
        echo "No NVIDIA GPU here: installing PyTorch's build for CPUs. 0.43 GB to download in all, 1.8 GB on disk."
        set -- --extra-index-url "$cpu_builds" "$@"
    else
        echo "$cpu_builds does not answer: installing the torch that pip finds. If it is PyPI's, 3.0 GB to download in all."
    fi
fi

pip_is_configured() { "$python" -m pip config list 2>/dev/null | grep -qE "index-url|find-links|no-index|proxy|cert"; }
# As pip does, of all indexes the best version: the build for CPUs counts as newer than the same version without.
by_uv() { uv pip install --python "$python" --index-strategy unsafe-best-match "$@"; }
# pip would compile one file after another, for a third of its time.
by_pip() {
    "$python" -m pip install --disable-pip-version-check --progress-bar on --no-compile "$@"
    "$python" -m compileall -q -j 0 .venv/lib >/dev/null || :  # of all cores; some files are templates
}

# pip says nothing while it unpacks and installs: a line whenever the environment has grown, until this script has ended.
tell_growth() {
    told=0
    while sleep 8 && kill -0 $$; do
        now=$(du -sm .venv | cut -f1)
        [ "$now" -eq "$told" ] || echo "installing: $now MB in .venv so far"
        told=$now
    done
}
tell_growth &
trap 'kill $! 2>/dev/null || :' EXIT
trap 'exit 130' INT TERM

if command -v uv >/dev/null 2>&1 && ! pip_is_configured; then
    by_uv "$@" || by_pip "$@"
else
    by_pip "$@"
fi
