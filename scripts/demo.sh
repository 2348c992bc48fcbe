#!/usr/bin/env bash
# Sets up, then runs the main job on 2 ranks (a ring of bars thrown against a wall) and renders it.
#
# usage: scripts/demo.sh [OPTIONS OF THE RUN...]     e.g. scripts/demo.sh --set time.end=1e-3
# PFEM_CASE chooses another case, PFEM_RANKS the number of ranks, PFEM_RESULT the folder of the result.
set -euo pipefail

bash "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"

case=${PFEM_CASE:-ring_impact}
result=${PFEM_RESULT:-$root/results/$case}

cd "$root"
mpirun -n "${PFEM_RANKS:-2}" "$python" -m pfem_petsc "$case" -o "$result" "$@"
"$python" -m pfem_petsc render "$result"
"$python" -m pfem_petsc plot "$result"

echo
echo "The result, for ParaView: $result/result.vtkhdf"
echo "Pictures, video and curves:"
find "$result" -maxdepth 2 -type f \( -name '*.png' -o -name '*.mp4' -o -name '*.gif' -o -name '*.svg' -o -name '*.pdf' \) \
    -printf '  %p\n' | sort
