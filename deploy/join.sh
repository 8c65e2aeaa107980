#!/usr/bin/env bash
# Sets up any machine and plays actors of a run whose hub is on another one.
set -euo pipefail

usage() {
    cat <<'END'
usage: deploy/join.sh --hub tls/HOST:PORT [--certificates DIR] [--actors N] [--run NAME] [--backend NAME]
                      [--set KEY=VALUE ...]

Sets up this machine if necessary, as deploy/run_local.sh does, then plays actors of a run. They take its
configuration from the run's learner, wait for hub and learner, and are started again when they end or are
stuck. Ctrl-C stops them; the same command joins again, and sends what was not sent yet.

  --hub ENDPOINT      where the hub listens, such as tls/hub.example:7447
  --certificates DIR  folder with authority.crt, actor.crt and actor.key (default:
                      ~/.config/vmdnn/certificates)
  --actors N          number of actors (default: one for each core that this machine, container or job
                      may use)
  --run NAME          name of the run (default: experiment1)
  --backend NAME      the simulator of these actors (default: that of the run)
  --set KEY=VALUE     override a value, such as run.folder=DIR; may be repeated

Files are written to RUN.FOLDER/NAME, by default runs/experiment1 in the current folder. Exit status: 0
stopped by you, 1 the supervisor was killed, 2 bad input.
END
}

chosen=()
previous=
for argument in "$@"; do
    if [[ "$argument" == -h || "$argument" == --help ]]; then
        usage
        exit
    fi
    if [[ "$previous" == --backend ]]; then chosen=(--backend "$argument"); fi
    previous="$argument"
done

# shellcheck source=deploy/setup.sh
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
setup "${chosen[@]}"
PYTHONPATH="$ROOT${PYTHONPATH:+:$PYTHONPATH}" exec "$VENV/bin/python" -m deploy.join "$@"
