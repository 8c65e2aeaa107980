#!/usr/bin/env bash
# Makes the certificates by which the processes of a run know each other; see docs/security.md.
set -euo pipefail

usage() {
    cat <<'END'
usage: deploy/certificates.sh [--out DIR] [--hosts HOST ...] [--actors NAME ...] [--days N] [--renew]

Makes an authority and a certificate for each role: hub, learner, evaluator, recorder, actor, operator
and watcher. What is there already stays. Prints the certificates that it made.

  --out DIR        the folder (default: ~/.config/vmdnn/certificates)
  --hosts HOST     names and addresses at which the other machines reach the hub (default: this machine's
                   name); localhost is always among them
  --actors NAME    besides, a certificate actor-NAME for the actors of one machine
  --days N         how long they are valid (default: 365); the authority is valid for ten years
  --renew          make all certificates again, with new keys, by the same authority

Give each machine authority.crt, and NAME.crt and NAME.key of what runs there, no more. Keep authority.key:
whoever has it can make certificates. Exit status: 0 done, 2 bad input.
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
setup_python
setup_packages
PYTHONPATH="$ROOT${PYTHONPATH:+:$PYTHONPATH}" exec "$VENV/bin/python" -m deploy.certificates "$@"
