#!/usr/bin/env bash
# Renews lock/: run.txt is what mp4ds needs and what builds it, test.txt what its tests need besides;
# for each Python and system the newest versions, with the hashes of their files.
set -euo pipefail
cd "$(dirname "$0")/.."
[ -x .venv/bin/python ] || "${PYTHON:-python3}" -m venv .venv
[ -x .venv/bin/uv ] || .venv/bin/python -m pip install --quiet uv
work=$(mktemp -d)
trap 'rm -r "$work"' EXIT
compile() {
  .venv/bin/uv pip compile --quiet --universal --python-version 3.10 --generate-hashes --no-header \
    --no-annotate --no-emit-index-url --no-emit-find-links pyproject.toml "$@" >/dev/null
}
lines() { awk '{ printf "%s%s", $0, /\\$/ ? "\t" : "\n" }' "$1"; } # a package on one line
sed -n 's/^requires = \[\(.*\)\]$/\1/p' pyproject.toml | tr -d '" ' | tr , '\n' >"$work/build.in"
compile --extra test --output-file "$work/all.txt"
compile "$work/build.in" --constraint "$work/all.txt" --output-file "$work/run.txt"
mkdir -p lock
mv "$work/run.txt" lock/run.txt
{ echo "--requirement run.txt" && grep -vxFf <(lines lock/run.txt) <(lines "$work/all.txt") | tr '\t' '\n'; } >lock/test.txt
