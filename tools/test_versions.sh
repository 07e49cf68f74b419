#!/usr/bin/env bash
# Takes the README's first command and the quick tests through every Python of this machine, each with
# the newest and with the lowest dependencies (not those of lock/), and prints a table. Each gets a
# clone and an environment of its own in build/versions, and a log. Beside LeRobot, which is for newer
# Pythons and takes 5 GB, datasets are only read: that is tested with those of the conformance suite.
#
#   bash tools/test_versions.sh [ARGUMENT OF PYTEST ...]
#   PYTHONS="3.10 3.13" DEPENDENCIES=lowest bash tools/test_versions.sh tests/test_video_file.py
set -euo pipefail
cd "$(dirname "$0")/.."
unset PYTHONDONTWRITEBYTECODE # as in tools/test.sh
work=$PWD/build/versions
mkdir -p "$work"

# without the notebook, which packs
reading=(tests/test_{conformance,layers,library,platforms,random_access,report,torch}.py
  -k "not notebook")

# the interpreter of a version: on the path, or of pyenv
python_of() {
  local found
  for found in "$(command -v "python$1")" "${PYENV_ROOT:-$HOME/.pyenv}/versions/$1".*/bin/python; do
    [ -x "$found" ] && "$found" -c '' 2>/dev/null && echo "$found" && return
  done
  return 1
}

# in a clone beside the real recordings, if there are any
try() (
  set -e
  rm -rf "$place" && mkdir "$place" && git clone --quiet . "$place/mp4ds"
  [ ! -d ../shared ] || ln -s "$(realpath ../shared)" "$place/shared"
  cd "$place/mp4ds"
  export PYTHON=$python DEPENDENCIES=$dependencies
  if [ $dependencies = lerobot ]; then
    set -- "${reading[@]}" "$@"
  else
    bash examples/quickstart.sh
  fi
  bash tools/install.sh test
  .venv/bin/python -m pip list --format freeze
  .venv/bin/pytest -n auto --dist worksteal -q -m "not slow and not network" "$@"
)

failed=0
rows=()
for version in ${PYTHONS:-3.10 3.11 3.12 3.13 3.14}; do
  python=$(python_of "$version") || { rows+=("$version|not on this machine||"); continue; }
  for dependencies in ${DEPENDENCIES:-lowest newest $([[ $version != 3.1[23] ]] || echo lerobot)}; do
    place=$work/$version-$dependencies
    log=$place.log
    echo "Python $version, $dependencies dependencies: $log"
    set +e # a command that a condition waits for does not stop at its first failure
    try "$@" >"$log" 2>&1
    [ $? = 0 ] && outcome=passed || { outcome=FAILED && failed=1; }
    set -e
    av=$(sed -n 's/^av==//p' "$log")
    equal=$(grep -c '^EQUAL$' "$log" || true)
    rows+=("$version|$dependencies, PyAV ${av:-?}|$([ $dependencies = lerobot ] && echo - || { [ "$equal" = 1 ] && echo equal || echo NO; })|$outcome: $(tail -n 1 "$log")")
  done
done
printf '%s\n' "Python|dependencies|quickstart|quick tests" "${rows[@]}" | column -t -s '|'
exit $failed
