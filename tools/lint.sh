#!/usr/bin/env bash
# Run every check that is not a test, from .venv; all of them, even when one fails.
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
failed=()

check() {
  local name=$1
  shift
  printf '== %s\n' "$name"
  "$@" || failed+=("$name")
}

check "ruff" .venv/bin/ruff check .
check "pyright" .venv/bin/pyright --pythonpath .venv/bin/python
check "import order" .venv/bin/lint-imports
check "notebook pairs" .venv/bin/python tools/check_notebooks.py
check "published results" .venv/bin/python tools/published.py --check
check "shell scripts" bash -n tools/*.sh .ci/run

if [ ${#failed[@]} -gt 0 ]; then
  printf '\nlint: failed: %s\n' "$(IFS=,; echo "${failed[*]}")" >&2
  exit 1
fi
echo "lint: all clean"
