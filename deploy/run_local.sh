#!/usr/bin/env bash
# One command from a fresh machine to a tutored iCub.
set -euo pipefail

usage() {
    cat <<'END'
usage: deploy/run_local.sh [--config FILE] [--actors N] [--backend NAME] [--set KEY=VALUE ...]

Sets up this machine if need be (.venv with the locked packages and, as root or with sudo, a
graphics driver), then starts hub, learner, evaluator, recorder and actors. What crashes comes
back. Shows what they do until the config's `done` is reached or Ctrl-C, stops everything, and
prints a summary. Started again with the same run, it goes on where it was.

  --config FILE     the run (default: deploy/config/experiment1.yaml); a run of a few minutes is
                    deploy/config/smoke.yaml
  --actors N        how many actors (default: one for each core)
  --backend NAME    the simulator: a built-in one, or your own as package.module:Class
  --set KEY=VALUE   override a value of the config, such as learner.rate=1e-3; may be repeated

Files go to RUN.FOLDER/RUN.NAME, by default runs/experiment1 where you are. Exit status: 0 done or
stopped by you, 1 something crashes again and again, 2 bad input.
END
}

for argument in "$@"; do
    if [[ "$argument" == -h || "$argument" == --help ]]; then
        usage
        exit
    fi
done

# shellcheck source=deploy/setup.sh
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
setup "$@"
PYTHONPATH="$ROOT${PYTHONPATH:+:$PYTHONPATH}" exec "$VENV/bin/python" -m deploy.run_local "$@"
