#!/usr/bin/env bash
# Makes a virtual environment in .venv, installs the package with its test tools, as lock/ has them,
# and tests it. Arguments are for pytest.
set -euo pipefail
cd "$(dirname "$0")/.."
unset PYTHONDONTWRITEBYTECODE # or each of some hundred processes compiles all modules anew
bash tools/install.sh test
.venv/bin/ruff check .
.venv/bin/ruff format --check .
.venv/bin/mypy
# of no other file than those of NETWORKS in tests/conftest.py: to collect all takes 10 seconds
networks=(tests/test_play_ros1.py tests/test_publish_{dds,ros1,ros2}.py
  tests/test_record_{ros1,ros2}.py tests/test_ros_packages.py)
# both run, whatever comes of the other; those of networks mostly wait, and so beside the others
report=$(mktemp)
trap 'kill "$beside" 2>/dev/null || true; rm -f "$report"; exit 130' INT TERM
.venv/bin/pytest -rs -n 1 -m "network and not slow" "${@:-${networks[@]}}" >"$report" 2>&1 &
beside=$! outcome=0
# the tests of a file stay together, and share what it packs, until a process has nothing to do
.venv/bin/pytest -rs -n auto --dist worksteal -m "not network and not slow" "$@" || outcome=$?
other=0
wait "$beside" || other=$?
cat "$report"
rm -f "$report"
# 5, of pytest: no test was chosen, which is a failure if it is so in both
[ $outcome != 5 ] || { outcome=$other other=5; }
[ $other = 5 ] || [ $other -le $outcome ] || outcome=$other
exit $outcome
