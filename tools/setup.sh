#!/usr/bin/env bash
# Set up .venv on a machine that may have nothing but git and build-essential.
#
#   tools/setup.sh demo    core, FMUs, plots: wheels and a C compiler only
#   tools/setup.sh test    all of the above, notebooks, linters, and scikits.odes built against the system's SUNDIALS
#
# PYTHON=/path/to/python3.11 chooses the interpreter; otherwise /usr/bin/python3 if it will do, else the first one on
# PATH that will. System packages are installed only when something is missing.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

purpose=${1:-}
venv=.venv
python=  # found by find_python

say() { printf 'setup: %s\n' "$*"; }
fail() {
  printf '\nsetup: %s\n' "$1" >&2
  shift
  [ $# -eq 0 ] || printf '       %s\n' "$@" >&2
  exit 1
}

# ---- system packages -----------------------------------------------------------------------------------------------

lacking=() packages=()

# lacks WHAT PACKAGE...: note something that the system lacks and the Debian packages that bring it
lacks() {
  lacking+=("$1")
  packages+=("${@:2}")
}

# Install what is noted with apt-get, as root or through sudo, or say what an administrator has to do.
install_packages() {
  [ ${#packages[@]} -gt 0 ] || return 0
  local what by_hand
  local -a as_root=() options=(-o DPkg::Lock::Timeout=300)
  printf -v what '%s, ' "${lacking[@]}"
  what="this system lacks ${what%, }"
  by_hand="apt-get update && apt-get install -y --no-install-recommends ${packages[*]}"
  command -v apt-get >/dev/null ||
    fail "$what, and it has no apt-get." "Install what Debian calls: ${packages[*]}" "Then run this again."
  if [ "$(id -u)" -ne 0 ]; then
    command -v sudo >/dev/null ||
      fail "$what; this is not root, and there is no sudo." "An administrator can install it with" "" "  $by_hand" ""
    as_root=(sudo)
    [ -t 0 ] || as_root+=(-n) # nobody there to type a password
  fi
  say "$what; installing ${packages[*]}"
  as_root+=(env DEBIAN_FRONTEND=noninteractive)
  "${as_root[@]}" apt-get "${options[@]}" update -q || say "the package lists could not be refreshed; trying with those here"
  "${as_root[@]}" apt-get "${options[@]}" install -q -y --no-install-recommends "${packages[@]}" ||
    fail "$what, and installing it failed." "The reason is above. An administrator can install it with" "" "  $by_hand" ""
}

# ---- the interpreter -----------------------------------------------------------------------------------------------

# Print the real path of the interpreter $1 if it will do, or else why not.
probe() {
  "$1" - <<'PYTHON' 2>&1
import os, sys, sysconfig
if not (3, 11) <= sys.version_info[:2] <= (3, 12):
    sys.exit(f"is Python {sys.version.split()[0]}; 3.11 or 3.12 is needed")
if not os.path.exists(os.path.join(sysconfig.get_path("include"), "Python.h")):
    sys.exit("has no C headers (python3-dev)")
try:
    import ensurepip, venv
except ImportError:
    sys.exit("cannot make virtual environments (python3-venv)")
print(sys.executable)
PYTHON
}

find_python() {
  local candidate answer
  for candidate in ${PYTHON:-/usr/bin/python3 python3.11 python3.12 python3}; do
    command -v "$candidate" >/dev/null || { [ -z "${PYTHON:-}" ] || say "there is no $candidate"; continue; }
    if answer=$(probe "$candidate"); then
      python=$answer
      return 0
    fi
    say "$candidate ${answer##*$'\n'}"
  done
  return 1
}

venv_works() { [ -x $venv/bin/python ] && $venv/bin/python -m pip --version >/dev/null 2>&1; }

# Note what the system lacks for making .venv.
look_for_python() {
  if venv_works; then
    [ -z "${PYTHON:-}" ] || [ "$(base_of "$PYTHON")" = "$(base_of $venv/bin/python)" ] ||
      fail "$venv was made by another interpreter than PYTHON=$PYTHON." "Remove it with 'make distclean' and run this again."
  elif ! find_python; then
    [ -z "${PYTHON:-}" ] || fail "PYTHON=$PYTHON will not do; the reason is above."
    lacks "Python 3.11 or 3.12 with headers and venv" python3 python3-venv python3-dev
  fi
}

make_venv() {
  venv_works && return
  [ -n "$python" ] || find_python || fail "the system's Python will not do; the reason is above." \
    "Name an interpreter: make PYTHON=/path/to/python3.11 $purpose"
  say "making $venv with $python"
  "$python" -m venv --clear $venv || fail "'$python -m venv $venv' failed; the reason is above."
}

base_of() { "$1" -c 'import sys; print(sys.base_prefix, sys.version_info[:2])'; }

# ---- SUNDIALS and scikits.odes -------------------------------------------------------------------------------------

sundials_major() {
  printf '#include <sundials/sundials_config.h>\nmajor=SUNDIALS_VERSION_MAJOR\n' |
    cc ${SUNDIALS_INST:+-I"$SUNDIALS_INST/include"} -E -P - 2>/dev/null | sed -n 's/^major=//p'
}

look_for_sundials() {
  [ -z "$(sundials_major)" ] || ! command -v gfortran >/dev/null || return 0
  [ -z "${SUNDIALS_INST:-}" ] || fail "no SUNDIALS headers or no gfortran with SUNDIALS_INST=$SUNDIALS_INST."
  lacks "SUNDIALS with headers and gfortran" libsundials-dev gcc gfortran
}

check_sundials() {
  [ "$(sundials_major)" = 6 ] ||
    fail "scikits.odes as pinned in pyproject.toml needs SUNDIALS 6, found '$(sundials_major)'." \
      "Point SUNDIALS_INST at the prefix of a SUNDIALS 6 built from source."
}

# The requirements of one extra, as pyproject.toml pins them.
requirements() {
  $venv/bin/python -c '
import sys, tomllib
with open("pyproject.toml", "rb") as file:
    print(*tomllib.load(file)["project"]["optional-dependencies"][sys.argv[1]], sep="\n")' "$1"
}

install_scikits_odes() {
  local -a pins
  mapfile -t pins < <(requirements sundials)
  say "installing ${pins[*]} (built from source: about three minutes the first time)"
  # On Python 3.12 it builds against an older numpy only. pip before 25.3 reads the first variable, later ones the second.
  local constraints=$venv/constraints.txt
  echo 'numpy<2.5' >$constraints
  PIP_CONSTRAINT=$constraints PIP_BUILD_CONSTRAINT=$constraints $venv/bin/pip install "${pins[@]}" ||
    odes_failed "did not build"
  $venv/bin/python -c 'from scikits.odes.sundials.cvode import CVODE
solution = CVODE(lambda t, x, dx: dx.__setitem__(0, -x[0]), old_api=False).solve([0.0, 1.0], [1.0])
assert abs(solution.values.y[-1, 0] - 0.36788) < 1e-3, solution' || odes_failed "was installed but does not solve"
}

odes_failed() {
  fail "scikits.odes $1; the reason is above." "The tests need it: plants are integrated by SUNDIALS through it." \
    "It needs SUNDIALS 6 with headers, gcc, gfortran and python3-dev (Debian 12 has them: see tools/setup.sh)." \
    "The main job does not: 'make demo' works without."
}

# ---- main ----------------------------------------------------------------------------------------------------------

case "$purpose" in
  demo) extras=fmu,plot ;;
  test) extras=fmu,plot,study,cluster,tune,notebook,dev ;;
  *) fail "usage: tools/setup.sh demo|test" ;;
esac

command -v cc >/dev/null || lacks "a C compiler" build-essential
look_for_python
[ "$purpose" = demo ] || look_for_sundials
install_packages

make_venv
[ "$purpose" = demo ] || check_sundials
say "installing ctmhe[$extras]"
$venv/bin/pip install -e ".[$extras]" || fail "pip could not install ctmhe[$extras]; the reason is above."
[ "$purpose" = demo ] || install_scikits_odes
touch $venv/.ready-demo $venv/".ready-$purpose"
say "ready: $venv"
