#!/bin/bash
# A run that may take longer than a job: it stops with a checkpoint before the time limit, is queued again, and continues.
#
#   sbatch packaging/slurm_requeue.sh CASE FOLDER [MORE ARGUMENTS...]
#   sbatch --nodes=8 packaging/slurm_requeue.sh my_case.toml results/my_case --set output.checkpoint_minutes=20
#
# The job is also queued again after a preemption or the loss of a node (--requeue), and then continues from the newest
# checkpoint of `checkpoint_minutes`. It ends when the run is done, fails, or was queued MOST_RESTARTS times (default 100).
#SBATCH --job-name=pfem
#SBATCH --nodes=4 --ntasks-per-node=32 --cpus-per-task=1
#SBATCH --time=02:00:00
#SBATCH --signal=TERM@300
#SBATCH --requeue --open-mode=append
set -uo pipefail

if [[ $# -lt 2 ]]; then
    echo "usage: sbatch $0 CASE FOLDER [MORE ARGUMENTS...]" >&2
    exit 2
fi
case=$1 folder=$2
shift 2

# What brings python with pfem_petsc: change this line.
if [[ -f ${PFEM_ACTIVATE:=.venv/bin/activate} ]]; then source "$PFEM_ACTIVATE"; fi
export OMP_NUM_THREADS=1

# TERM@300: five minutes before the limit each rank gets SIGTERM, finishes its step and writes the checkpoint: status 4.
# --restart starts from zero where there is no checkpoint yet, and after a run that is done says so, with status 0.
srun --kill-on-bad-exit=0 python -m pfem_petsc "$case" -o "$folder" --quiet "$@" --restart
status=$?

case $status in
    0) echo "the run in $folder is done" ;;
    4)
        if [[ ${SLURM_RESTART_COUNT:-0} -ge ${MOST_RESTARTS:-100} ]]; then
            echo "stopped with a checkpoint in $folder after ${SLURM_RESTART_COUNT} restarts: not queued again" >&2
            exit 4
        fi
        echo "stopped with a checkpoint in $folder: queued again"
        scontrol requeue "$SLURM_JOB_ID" || { echo "cannot be queued again: submit it once more" >&2; exit 4; }
        ;;
    *) echo "the run in $folder failed with status $status: not queued again; its message is above" >&2 ;;
esac
# After a requeue the status of this part does not matter, and must not count as a failure.
if [[ $status == 4 ]]; then exit 0; fi
exit "$status"
