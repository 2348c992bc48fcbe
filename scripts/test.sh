#!/usr/bin/env bash
# Sets up and runs the tests (--all-sets: all of them): serial, then those marked parallel on 2 and on 3 ranks.
#
# usage: scripts/test.sh [--build-petsc] [PYTEST ARGUMENTS...]
# All three stages run whatever the others say; the status is 0 when all passed. TEST_LIMIT [s] ends a stage
# that hangs: 10800 unless set, many times what a slow machine takes.
set -uo pipefail

setup=(--dev)
if [[ ${1:-} == --build-petsc ]]; then
    setup+=("$1")
    shift
    export PFEM_VENV=${PFEM_VENV:-.venv-petsc}
fi
bash "$(dirname "${BASH_SOURCE[0]}")/setup.sh" "${setup[@]}" || exit
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"
cd "$root" || exit

# Byte code of the tests is made once for all stages.
unset PYTHONDONTWRITEBYTECODE

limit=${TEST_LIMIT:-10800}
log=$(mktemp)
trap 'rm -f "$log"' EXIT
status=0
summary=""
failures=""

# stage NAME COMMAND...: one run of pytest, whose closing line is kept. No parallel test collected (5) is no failure
# where pytest's own arguments choose the tests.
stage() {
    local name=$1 result line
    shift
    echo "== $name"
    "$@" 2>&1 | tee "$log"
    result=${PIPESTATUS[0]}
    [[ $result == 5 && $selected == yes && $name != "1 rank" ]] && result=0
    # mpirun gives its ranks a terminal, whatever there is outside: colours and carriage returns.
    line=$(sed 's/\x1b\[[0-9;]*m//g; s/\r$//' "$log" | grep -E '^(=+ )?[0-9]+ .* in [0-9.]+s' | tail -n 1)
    if [[ $result == 0 ]]; then
        summary="$name: passed"$'\n'"${line:-no closing line}"$'\n'"$summary"
    else
        failures="$failures$name: failed (status $result)"$'\n'"${line:-no closing line: ended after at most $limit s}"$'\n'
        status=1
    fi
}

color=$([[ -t 1 ]] && echo yes || echo no)
selected=$([[ $# -gt 0 ]] && echo yes || echo no)
jobs=${TEST_JOBS:-2}
stage "1 rank" timeout --kill-after=15 "$limit" "$python" -m pytest -n "$jobs" --dist worksteal --color="$color" \
    --durations=5 "$@"
stage "2 ranks" on_ranks 2 "$limit" "$python" -m pytest --color="$color" "$@"
stage "3 ranks" on_ranks 3 "$limit" "$python" -m pytest --color="$color" "$@"

# The last line is a closing line of pytest: of the first stage, which runs every test, or of the last that failed.
printf '\n%s%s' "$summary" "$failures"
exit "$status"
