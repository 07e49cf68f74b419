#!/usr/bin/env bash
# Installs mp4ds into a virtual environment and takes a small recording there and back. --force: what
# the script made before is replaced, and nothing else.
set -euo pipefail
cd "$(dirname "$0")/.."
work=${1:-quickstart}
bash tools/install.sh
mkdir -p "$work"
export PATH="$PWD/${VENV:-.venv}/bin:$PATH"
mp4ds demo "$work/demo.mcap" --force
mp4ds pack "$work/demo.mcap" -o "$work/demo" --force
mp4ds validate "$work/demo" --deep
mp4ds unpack "$work/demo" --to mcap -o "$work/again.mcap" --force
python tools/compare.py "$work/demo.mcap" "$work/again.mcap"
