#!/usr/bin/env bash
# Converts frames on a Slurm cluster: a job array with a task for each shard, and then a job that verifies the results.
#
#     examples/farm/submit.sh 60 --cpus-per-task=4 --time=30 -- '/shots/dam/*.bgeo' --out /shots/dam/meshes --preset splash
#
# First come the number of shards (60%16: at most 16 tasks at a time) and options of sbatch, each as --NAME=VALUE. --cpus-per-task,
# --mem, --mem-per-cpu and --gres are for the tasks; the others, such as --partition and --account, also apply to the job that
# verifies. After -- come the arguments of meniscus convert: the inputs, --out and the folder of the results, then any options.
# The folders must have the same path on all machines. MENISCUS is the path of the program, if it is not in the PATH.
#
# If frames are missing, submit the same again: a shard skips finished frames. Slurm needs seconds to start a task: choose shards
# that take at least a minute. Many tasks with few threads are faster than few tasks with many.
set -euo pipefail

refuse() {
    echo "error: $1" >&2
    echo "usage: $0 SHARDS [--NAME=VALUE for sbatch]... -- INPUT... --out OUT [option of meniscus convert]..." >&2
    exit 2
}
here="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
shards="${1:-}"
[[ "$shards" =~ ^[1-9][0-9]*(%[1-9][0-9]*)?$ ]] || refuse "expected the number of shards"
shift

of_tasks=() of_every_job=()
while [ $# -gt 0 ] && [ "$1" != -- ]; do
    case "$1" in
    --array=*) refuse "$1: the array is made from the number of shards" ;;
    --cpus-per-task=* | --mem=* | --mem-per-cpu=* | --gres=*) of_tasks+=("$1") ;;
    --*=*) of_every_job+=("$1") ;;
    *) refuse "$1: write options as --NAME=VALUE" ;;
    esac
    shift
done
[ "${1:-}" = -- ] || refuse "expected -- before the inputs"
shift
inputs=()
while [ $# -gt 0 ] && [[ "$1" != -* ]]; do
    inputs+=("$1")
    shift
done
if [ ${#inputs[@]} = 0 ] || [ "${1:-}" != --out ] || [ -z "${2:-}" ]; then refuse "expected inputs, then --out OUT"; fi

# A shard refuses a folder that does not exist, because it may not be mounted.
[ -d "$2" ] || mkdir "$2"
job="$(sbatch --parsable --array="1-$shards" "${of_tasks[@]}" "${of_every_job[@]}" "$here/shard.sbatch" "${inputs[@]}" "$@")"
job="${job%%;*}"
verify="$(sbatch --parsable --dependency="afterany:$job" "${of_every_job[@]}" "$here/gather.sbatch" "$2" --input "${inputs[@]}")"
echo "$job ${verify%%;*}"
