#!/usr/bin/env bash
# Installs mp4ds into a virtual environment and takes a small recording there and back. --force: what
# the script made before is replaced, and nothing else.
set -euo pipefail
cd "$(dirname "$0")/.."
work=${1:-quickstart}
[ -x .venv/bin/python ] || "${PYTHON:-python3}" -m venv .venv
.venv/bin/python -m pip install --quiet .
mkdir -p "$work"
export PATH="$PWD/.venv/bin:$PATH"
mp4ds demo "$work/demo.bag" --force
mp4ds pack "$work/demo.bag" -o "$work/demo" --force
mp4ds validate "$work/demo" --deep
mp4ds unpack "$work/demo" --to bag -o "$work/again.bag" --force
python tools/compare.py "$work/demo.bag" "$work/again.bag"
