#!/usr/bin/env bash
# Run the tests in .venv, two at a time: fast ones first, then slow ones, then the notebooks. Stops at the first group
# that fails.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
pytest=(.venv/bin/python -m pytest)

# pytest leaves with 5 when a group is empty: fine for a group, not for the fast tests
group() {
  local code=0
  "$@" || code=$?
  [ $code -eq 0 ] || [ $code -eq 5 ] || exit $code
}

"${pytest[@]}" -n 2 -m 'not slow' --durations=5
group "${pytest[@]}" -n 2 -m slow --durations=5

shopt -s nullglob
notebooks=(notebooks/*.ipynb)
if [ ${#notebooks[@]} -gt 0 ]; then
  # warnings inside Jupyter's machinery are not ours to mend
  group "${pytest[@]}" -n 2 --nbmake --nbmake-timeout=600 -W default "${notebooks[@]}"
fi
