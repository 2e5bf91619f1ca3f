#!/usr/bin/env bash
# A plan on a Slurm cluster: an array with a task for each shard, and a job after it that looks at the whole.
#
#     meniscus plan /shots/dam/*.bgeo --out /shots/dam/meshes --shards 60 -o /shots/dam/plan.json
#     examples/farm/submit.sh /shots/dam/plan.json --cpus-per-task=4
#     examples/farm/submit.sh /shots/dam/plan.json --array=3,17-19
#
# What follows the plan is for sbatch, each as --NAME=VALUE: --array=0-59%16 for no more than 16 at a time, or the shards that verify
# says are to be run again; --cpus-per-task and --mem of a task. What the cluster demands of every job, such as --partition and --account, is
# for the job that verifies as well. The plan, the inputs and the folder of the results must have the same path on all
# machines. MENISCUS is the program, if it is not in the PATH.
#
# Starting a task takes Slurm seconds: choose shards of a minute at least. Many tasks with few threads get more done than
# few tasks with many.
set -euo pipefail

[ $# -gt 0 ] || { echo "usage: $0 PLAN [--NAME=VALUE for sbatch]..." >&2; exit 2; }
here="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
plan="$(realpath "$1")"
shift
of_plan='import json, sys; plan = json.load(open(sys.argv[1])); print(len(plan["shards"]) - 1, plan["out"])'
read -r last out < <(python3 -c "$of_plan" "$plan" 2>/dev/null) || { echo "$plan: no plan, or python3 is not here to read it" >&2; exit 2; }

for_every_job=()
for option in "$@"; do
    case "$option" in
    --array=* | --cpus-per-task=* | --mem=* | --mem-per-cpu=* | --gres=*) ;;
    --*=*) for_every_job+=("$option") ;;
    *) echo "$option: give options as --NAME=VALUE" >&2 && exit 2 ;;
    esac
done

# The last --array counts: one that was given replaces that of the whole plan.
job="$(sbatch --parsable --array="0-$last" "$@" "$here/shard.sbatch" "$plan")"
job="${job%%;*}"
verify="$(sbatch --parsable --dependency="afterany:$job" "${for_every_job[@]}" "$here/gather.sbatch" "$plan" "$out")"
echo "$job ${verify%%;*}"
