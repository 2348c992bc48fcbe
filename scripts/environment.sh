# shellcheck shell=bash disable=SC2034,SC2154
# Sourced by the scripts here: which Python, and the settings under which it runs on several ranks of one machine.
#
# PFEM_VENV   the virtual environment; default .venv, or .venv-petsc when the script is given --build-petsc
# After it:   $root (the checkout), $venv, $python, and the function on_ranks.

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
venv=${PFEM_VENV:-.venv}
[[ $venv == /* ]] || venv=$root/$venv
python=$venv/bin/python

# One thread a rank: the ranks are the parallelism.
export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1

# Open MPI refuses root and more ranks than cores unless told (version 4, then 5), binds ranks of unrelated jobs to the
# same core, and in containers may not read another process's memory.
export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1
export PRTE_ALLOW_RUN_AS_ROOT=1 PRTE_ALLOW_RUN_AS_ROOT_CONFIRM=1
export OMPI_MCA_rmaps_base_oversubscribe=1 PRTE_MCA_rmaps_default_mapping_policy=:oversubscribe
export OMPI_MCA_hwloc_base_binding_policy=${OMPI_MCA_hwloc_base_binding_policy:-none}
export OMPI_MCA_btl_vader_single_copy_mechanism=${OMPI_MCA_btl_vader_single_copy_mechanism:-none}
# A rank that waits lets others run.
export OMPI_MCA_mpi_yield_when_idle=${OMPI_MCA_mpi_yield_when_idle:-1}
# A process started without mpirun starts no daemon in case it launches others.
export OMPI_MCA_ess_singleton_isolated=1
export HWLOC_HIDE_ERRORS=2

# Without a display, VTK draws in software where OSMesa is there, and looks for EGL itself where it is not.
if [[ -z ${DISPLAY:-} ]] && ldconfig -p 2>/dev/null | grep -q libOSMesa; then
    export VTK_DEFAULT_OPENGL_WINDOW=${VTK_DEFAULT_OPENGL_WINDOW:-vtkOSOpenGLRenderWindow}
fi

# on_ranks RANKS SECONDS COMMAND...: run a command under mpirun, ended (status 124) after that many seconds.
on_ranks() {
    timeout --kill-after=15 "$2" mpirun -n "$1" "${@:3}"
}
