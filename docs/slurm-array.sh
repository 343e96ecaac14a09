#!/bin/bash
# A campaign as an array of Slurm jobs, one shard each, in DIR/shard-0 to DIR/shard-9; the whole comes to DIR/whole.
#
#     sbatch --array=0-9 docs/slurm-array.sh CAMPAIGN DIR 10
#     docs/slurm-array.sh merge DIR
#
# A job that was ended before its time goes on where it was when it is submitted again, alone or with all others: what is done
# stays done.
#SBATCH --job-name=corotate-sweep
#SBATCH --cpus-per-task=2
#SBATCH --requeue

set -eu

if [ "$1" = merge ]; then
    exec corotate sweep merge "$2"/shard-* --out "$2/whole"
fi
exec corotate sweep "$1" --out "$2/shard-$SLURM_ARRAY_TASK_ID" --shard "$SLURM_ARRAY_TASK_ID/$3" \
    --threads "$SLURM_CPUS_PER_TASK"
