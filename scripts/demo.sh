#!/usr/bin/env bash
# Sets up, then runs the main job on 2 ranks (a ring of bars thrown against a wall) and renders it.
#
# usage: scripts/demo.sh [--build-petsc] [OPTIONS OF THE RUN...]     e.g. scripts/demo.sh --set time.end=1e-3
# PFEM_CASE chooses another case, PFEM_RANKS the number of ranks, PFEM_RESULT the folder of the result.
set -euo pipefail

setup=()
if [[ ${1:-} == --build-petsc ]]; then
    setup+=("$1")
    shift
    export PFEM_VENV=${PFEM_VENV:-.venv-petsc}
fi
bash "$(dirname "${BASH_SOURCE[0]}")/setup.sh" "${setup[@]}"
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"

case=${PFEM_CASE:-ring_impact}
result=${PFEM_RESULT:-$root/results/$case}

cd "$root"
mpirun -n "${PFEM_RANKS:-2}" "$python" -m pfem_petsc "$case" -o "$result" "$@"
"$python" -m pfem_petsc render "$result"
"$python" -m pfem_petsc plot "$result"

echo
echo "The result, for ParaView: $result/result.vtkhdf"
echo "Pictures, video and curves (single frames: $result/frames):"
find "$result" -maxdepth 1 -type f -regextype posix-extended -regex '.*\.(png|mp4|gif|svg|pdf)' -printf '  %p\n' | sort
