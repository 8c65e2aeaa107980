#!/usr/bin/env bash
# Sets up a fresh machine and plays a run on it.
set -euo pipefail

usage() {
    cat <<'END'
usage: deploy/run_local.sh [--config FILE] [--actors N|NAME=N,...] [--backend NAME] [--set KEY=VALUE ...]

Sets up this machine if necessary (.venv with the locked packages and, as root or with sudo, a
graphics driver), then starts hub, learner, evaluator, recorder, actors and a page for the browser,
whose address it prints (--set dashboard.enabled=false leaves it out). Processes that end or are stuck are started again. Shows their state until the config's `done` is reached or Ctrl-C is pressed, then
stops all processes and prints a summary. The same command continues a run that was stopped.

  --config FILE     a file, or the name of a configuration in deploy/config (default:
                    experiment1); smoke takes a few minutes
  --actors N        number of actors (default: one for each core); or numbers by simulator, such as
                    sapien=1,mujoco=1
  --backend NAME    the simulator: a built-in one, or your own as package.module:Class
  --set KEY=VALUE   override a value of the config, such as learner.rate=1e-3; may be repeated

Files are written to RUN.FOLDER/RUN.NAME, by default runs/experiment1 in the current folder. Exit
status: 0 done or stopped by you, 1 the supervisor was killed, 2 bad input.
END
}

for argument in "$@"; do
    if [[ "$argument" == -h || "$argument" == --help ]]; then
        usage
        exit
    fi
done

# shellcheck source=deploy/setup.sh
source "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/setup.sh"
setup "$@"
# Until run_local handles signals itself, Ctrl-C ends it without a stack trace: nothing is started yet.
PYTHONPATH="$ROOT${PYTHONPATH:+:$PYTHONPATH}" exec "$VENV/bin/python" -c '
import runpy, signal
signal.signal(signal.SIGINT, signal.SIG_DFL)
runpy.run_module("deploy.run_local", run_name="__main__", alter_sys=True)' "$@"
