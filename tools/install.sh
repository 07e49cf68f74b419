#!/usr/bin/env bash
# Installs mp4ds into the virtual environment $VENV (.venv), which it makes if there is none. Given
# "test", it installs the source tree itself, with all that its tests need. DEPENDENCIES are those of
# lock/ ("locked"), which no release can break, or the "newest" or "lowest" that pyproject.toml allows,
# or those beside "lerobot", whose PyAV is too old to pack.
set -euo pipefail
cd "$(dirname "$0")/.."
venv=${VENV:-.venv}
[ -x "$venv/bin/python" ] || "${PYTHON:-python3}" -m venv "$venv"
install() { "$venv/bin/python" -m pip install --quiet --disable-pip-version-check "$@"; }
case ${1:-run} in
  run) what=(.) ;;
  test) what=(--editable '.[test]') ;;
esac
case ${DEPENDENCIES:-locked} in
  locked)
    install --only-binary :all: --require-hashes --requirement "lock/${1:-run}.txt"
    install --no-deps --no-build-isolation "${what[@]}" # the lock has the build's backend, too
    ;;
  newest) install "${what[@]}" ;;
  lerobot)
    install 'lerobot[dataset]' .
    # with all that other tests need, pip would find nothing that fits together
    [ "${1:-run}" = run ] || install --editable . hypothesis nbclient pytest pytest-xdist
    ;;
  lowest)
    install "$(sed -n 's/^\(uv==[^ ]*\).*/\1/p' lock/test.txt)"
    # what these need in turn is as new as in the lock: today's newest may not fit them
    sed -n 's/^\([a-z0-9-]*\)==\([^\\]*\).*/\1<=\2/p' lock/*.txt >"$venv/newest.txt"
    # the lowest PyAV only reads
    sed -n 's/^WRITING = (\(.*\), \(.*\))$/av>=\1.\2/p' src/mp4ds/video/codecs.py >>"$venv/newest.txt"
    # wheels only: nobody means to build an old numpy for a new Python
    "$venv/bin/uv" pip install --quiet --python "$venv/bin/python" --resolution lowest-direct \
      --constraint "$venv/newest.txt" --build-constraint "$venv/newest.txt" \
      --only-binary :all: --no-binary mp4ds "${what[@]}"
    ;;
  *) echo "DEPENDENCIES is locked, newest, lowest or lerobot, not $DEPENDENCIES" >&2 && exit 2 ;;
esac
