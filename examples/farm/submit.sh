#!/usr/bin/env bash
# Submits a plan to a Slurm cluster: an array with a task for each shard, and a job that verifies the results after it.
#
#     meniscus plan /shots/dam/*.bgeo --out /shots/dam/meshes --shards 60 -o /shots/dam/plan.json
#     examples/farm/submit.sh /shots/dam/plan.json --cpus-per-task=4
#     examples/farm/submit.sh /shots/dam/plan.json --array=3,17-19
#
# The options after the plan are for sbatch, each as --NAME=VALUE: --array=0-59%16 for at most 16 tasks at a time, or the shards
# that verify listed; --cpus-per-task and --mem of a task. Options that the cluster requires for every job, such as --partition
# and --account, also apply to the job that verifies. The plan, the inputs and the results folder must have the same path on
# all machines. MENISCUS is the path of the program, if it is not in the PATH.
#
# Slurm needs seconds to start a task: choose shards that take at least a minute. Many tasks with few threads are faster than
# few tasks with many.
set -euo pipefail

[ $# -gt 0 ] || { echo "usage: $0 PLAN [--NAME=VALUE for sbatch]..." >&2; exit 2; }
here="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
plan="$(realpath "$1")"
shift
of_plan='import json, sys; plan = json.load(open(sys.argv[1])); print(len(plan["shards"]) - 1, plan["out"])'
read -r last out < <(python3 -c "$of_plan" "$plan" 2>/dev/null) || { echo "error: $plan: not a plan, or python3 is missing" >&2; exit 2; }

for_every_job=()
for option in "$@"; do
    case "$option" in
    --array=* | --cpus-per-task=* | --mem=* | --mem-per-cpu=* | --gres=*) ;;
    --*=*) for_every_job+=("$option") ;;
    *) echo "error: $option: write options as --NAME=VALUE" >&2 && exit 2 ;;
    esac
done

# The last --array wins, so an --array on the command line replaces that of the whole plan.
job="$(sbatch --parsable --array="0-$last" "$@" "$here/shard.sbatch" "$plan")"
job="${job%%;*}"
verify="$(sbatch --parsable --dependency="afterany:$job" "${for_every_job[@]}" "$here/gather.sbatch" "$plan" "$out")"
echo "$job ${verify%%;*}"
