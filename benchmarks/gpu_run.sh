#!/usr/bin/env bash
# One leg of the relay on a bare machine: install, smoke test, in the first leg tables of speed, train, pack.
# See docs/how-to/gpu-minutes.md.
#   bash benchmarks/gpu_run.sh            from the root of a checkout with wheels/ (benchmarks/gpu_wheels.sh)
# Environment: OUT, folder for what must come back (runs/relay_out); STATE, what came back from the last leg (relay/);
# LIMIT_S, seconds for everything (570); TABLES_S, seconds for the tables (300; 0 for none), and TABLES, their options;
# PRESET; PROCESSES; PYTHON. A step that fails lets the next begin.
set -u
cd "$(dirname "$0")/.."
begun=$(date +%s)
OUT=${OUT:-runs/relay_out} STATE=${STATE:-relay} LIMIT_S=${LIMIT_S:-570} PYTHON=${PYTHON:-python3}
run=runs/relay
mkdir -p "$OUT"
exec > >(tee "$OUT/log.txt") 2>&1
step() { echo "== $(($(date +%s) - begun)) s: $*"; }

step install
site=$(mktemp -d)
if [ -d wheels ]; then
    "$PYTHON" -m pip install --quiet --no-index --no-deps --no-compile --no-cache-dir --target "$site" wheels/*.whl
fi
export PYTHONPATH="$PWD/src:$site" PYTHONUNBUFFERED=1 XDG_CACHE_HOME=$site/cache
"$PYTHON" -c "import sys, torch; d = torch.cuda; print(sys.version.split()[0], torch.__version__, d.get_device_name() if d.is_available() else 'no GPU')"

step smoke
timeout -k 5 "${SMOKE_S:-90}" "$PYTHON" benchmarks/gpu_smoke.py

if [ "${TABLES_S:-300}" -gt 0 ] && [ ! -e "$STATE/relay_manifest.json" ]; then
    step tables
    timeout -k 5 "${TABLES_S:-300}" "$PYTHON" benchmarks/gpu_tables.py ${TABLES:-}
fi

step relay
if [ -e "$STATE/relay_manifest.json" ]; then
    "$PYTHON" benchmarks/relay unpack "$STATE" "$run" || exit 1  # never begin anew where a relay was to go on
fi
left=$((LIMIT_S - 30 - ($(date +%s) - begun)))
"$PYTHON" benchmarks/relay leg "$run" "$OUT" --seconds "$left" ${PRESET:+--preset "$PRESET"} ${PROCESSES:+--processes "$PROCESSES"}
step "done: take $OUT/relay_* to $STATE/ for the next leg"
