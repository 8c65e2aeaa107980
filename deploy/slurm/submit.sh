#!/bin/bash
# Written by `python -m deploy.manifests slurm`; change the configuration, not this file.
# Submits the run experiment1.
# Arguments, such as --partition=NAME --time=12:00:00, go to every sbatch.
set -euo pipefail
services="$(sbatch --parsable "$@" deploy/slurm/services.sbatch)"
services="${services%%;*}"
echo "hub, learner, evaluator and recorder: job $services"
sbatch --dependency="after:$services" "$@" deploy/slurm/actor.sbatch "$services"
