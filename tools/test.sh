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
trap 'exit 130' INT # Ctrl-C ends both
failed=0 found=5 # 5, of pytest: no test was chosen
stage() { # both run, whatever comes of the first; the worst outcome is that of all
  local outcome=0
  .venv/bin/pytest -rs "$@" || outcome=$?
  [ $outcome = 5 ] || found=0
  [ $outcome = 5 ] || [ $outcome -le $failed ] || failed=$outcome
}
# the tests of a file stay together, and share what it packs, until a process has nothing to do
stage -n auto --dist worksteal -m "not network and not slow" "$@"
# of no other file than those of NETWORKS in tests/conftest.py: to collect all takes 5 seconds
[ $# -gt 0 ] || set -- tests/test_play_ros1.py tests/test_publish_{dds,ros1,ros2}.py \
  tests/test_record_{ros1,ros2}.py tests/test_ros_packages.py
stage -n 2 --dist loadgroup -m "network and not slow" "$@"
exit $((failed > found ? failed : found))
