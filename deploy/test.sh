#!/usr/bin/env bash
# Sets up this checkout as run_local.sh does, but with all simulators, then checks it: format, lint, types
# and tests.
# Arguments go to pytest: `deploy/test.sh -m slow`, `deploy/test.sh tests/learner -k gradient`.
set -euo pipefail

# shellcheck source=deploy/setup.sh
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
for simulator in sapien mujoco; do setup --backend "$simulator"; done
cd "$ROOT"
.venv/bin/ruff format --check .
.venv/bin/ruff check .
.venv/bin/mypy
# A process for each core, but no more than four: each needs up to 2 GB. A file stays in one process.
exec .venv/bin/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile "$@"
