# shellcheck shell=bash
# Sourced by run_local.sh, join.sh, certificates.sh and test.sh. `setup` installs what this checkout needs to run: Python, a
# compiler, the locked packages in .venv, and what the simulator needs: its own packages and a graphics
# driver. Its arguments are those of run_local.sh, which select the simulator. It installs only what is
# missing. A second call with the same arguments takes a fraction of a second.

ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
VENV="$ROOT/.venv"
LOCK="$ROOT/deploy/requirements.lock"

setup() {
    setup_python
    setup_compiler
    setup_packages
    setup_simulator_once "$@"
}

say() { printf 'setup: %s\n' "$*" >&2; }

fail() {
    say "$@"
    exit 1
}

# --- Python -----------------------------------------------------------------------------------

# Prints the first Python that the lock is made for and that can make virtual environments.
find_python() {
    local python
    for python in python3 python3.12 python3.11; do
        if "$python" -c 'import sys, venv, ensurepip
sys.exit(sys.version_info[:2] not in ((3, 11), (3, 12)))' 2>/dev/null; then
            command -v "$python"
            return
        fi
    done
    return 1
}

setup_python() {
    "$VENV/bin/python" -c 'import pip' 2>/dev/null && return
    if ! PYTHON="$(find_python)"; then
        can_install || fail "Python 3.11 or 3.12 with venv is needed; as root: $(apt_line python3 python3-venv)"
        apt_install python3 python3-venv
        PYTHON="$(find_python)" || fail "Python 3.11 or 3.12 is needed, but this system's python3 is" \
            "$(python3 --version 2>&1); install one of them and start again"
    fi
    say "making .venv with $("$PYTHON" --version)"
    "$PYTHON" -m venv "$VENV"
}

# --- compiler ---------------------------------------------------------------------------------

# Training compiles its kernels for this machine's processor; without a compiler it is slower.
setup_compiler() {
    local compiler
    for compiler in "${CXX:-c++}" g++ clang++; do
        if command -v "$compiler" >/dev/null; then return; fi
    done
    if ! can_install; then
        say "there is no C++ compiler, so training will be slower; as root: $(apt_line g++)"
        return
    fi
    say "installing a C++ compiler"
    apt_install g++
}

# --- packages ---------------------------------------------------------------------------------

setup_packages() {
    local stamp="$VENV/installed" digest
    digest="$(cat "$LOCK" "$ROOT/pyproject.toml" | sha256sum)"
    [[ -f "$stamp" && "$(<"$stamp")" == "$digest" ]] && return
    say "installing $(grep -v extra "$LOCK" | grep -c ==) packages into .venv (takes minutes the first time)"
    # torch is installed first and with its dependencies, which depend on its build for this machine.
    pip_install --constraint "$LOCK" torch
    pip_install --no-deps --requirement "$LOCK"
    pip_install --no-deps --no-build-isolation --editable "$ROOT"
    local extra
    for extra in $(sed -n 's/.*; extra == "\(.*\)"$/\1/p' "$LOCK" | sort -u); do
        # An extra has the name of the package that a simulator imports.
        if "$VENV/bin/python" -c "import $extra" 2>/dev/null; then install_extra "$extra"; fi
    done
    setup_libraries
    printf '%s\n' "$digest" >"$stamp"
}

# Installs the locked packages of an extra: what one simulator needs and others do not.
install_extra() {
    local packages
    mapfile -t packages < <(sed -n "s/ *; extra == \"$1\"\$//p" "$LOCK")
    say "installing the packages of $1 (${packages[*]})"
    pip_install --no-deps "${packages[@]}"
}

# On a terminal pip shows its own progress bars; elsewhere there is a line now and then.
pip_install() {
    if [[ -t 1 ]]; then run_pip "$@"; else run_pip "$@" | tell_progress; fi ||
        fail "pip could not install; see above; is there a network?"
}

run_pip() {
    PYTHONWARNINGS=ignore "$VENV/bin/python" -m pip install --no-input --disable-pip-version-check \
        --root-user-action=ignore "$@"
}

# Reads pip's output and tells how many packages it has found, large downloads, and when it unpacks.
tell_progress() {
    local line packages=0
    while read -r line; do
        case "$line" in
            "Collecting "* | "Requirement already satisfied: "*)
                packages=$((packages + 1))
                if ((packages % 10 == 0)); then say "$packages packages so far"; fi
                ;;
            "Downloading "*[0-9][0-9]" MB)" | "Downloading "*[0-9][0-9].[0-9]" MB)" | "Downloading "*" GB)") say "${line,}" ;;
            "Installing collected packages: "*) say "unpacking" ;;
        esac
    done
}

# Some packages need shared libraries that a minimal system does not have: OpenMP and X11.
setup_libraries() {
    imports 2>/dev/null && return
    local libraries=(libgomp1 libx11-6)
    can_install || fail "shared libraries are missing; as root: $(apt_line "${libraries[@]}")"
    apt_install "${libraries[@]}"
    imports || fail "the packages cannot be imported; see above"
}

imports() {
    (cd "$ROOT" && "$VENV/bin/python" -W ignore -c 'import cv2, pinocchio
from actors.simulator import installed_backends, load_backend
for name in installed_backends(): load_backend(name)')
}

# --- simulator --------------------------------------------------------------------------------

# `setup_simulator`, unless it has succeeded and nothing has changed since: to render takes seconds. Each
# actor tries its driver anyway when it starts; if it cannot work, deploy.supervision removes the stamp.
setup_simulator_once() {
    local stamp="$VENV/simulator-ready"
    [[ -f "$stamp" && "$(<"$stamp")" == "$(simulator_depends_on "$@")" ]] && return
    SIMULATOR_READY=""
    setup_simulator "$@"
    [[ -n "$SIMULATOR_READY" ]] || return 0
    # What was installed just now has changed it. Without permission to write, the next call renders again.
    { simulator_depends_on "$@" >"$stamp"; } 2>/dev/null || true
}

# Prints a digest of what decides whether the simulator can render: the arguments and their files, the
# environment, the packages, our code, the system's packages and drivers, the devices, and the machine since
# it was started.
simulator_depends_on() {
    local argument
    {
        set +e # much of it is not there on most machines
        printf '%s\n' "$EUID" "$@"
        for argument in "$@"; do
            if [[ -f "${argument#*=}" ]]; then cat "${argument#*=}"; fi
        done
        cat "$VENV/installed" "$ROOT"/deploy/config/*.yaml "$ROOT"/actors/backends/{,*/}*.py \
            "$ROOT/actors/simulator.py" /proc/sys/kernel/random/boot_id
        env | grep -vE '^(_|SHLVL|PWD|OLDPWD|TERM|COLUMNS|LINES)=' | sort
        stat --format '%n %s %Y' "$VENV"/lib/python*/site-packages /var/lib/dpkg/status \
            {/etc,/usr/share,/usr/local/share}/*/*.d{,/*} # the lists of drivers are among these
        stat --format '%n %a %U %G' /dev/dri{,/*} /dev/nvidia*
        true
    } 2>/dev/null | sha256sum
}

# Each simulator reports whether it can render, and which packages provide its driver.
setup_simulator() {
    local answer extra status=0
    answer="$(examine_simulator "$@" 2>/dev/null)" || status=$?
    if ((status == 3)); then
        for extra in $answer; do install_extra "$extra"; done
        status=0
        answer="$(examine_simulator "$@" 2>/dev/null)" || status=$?
    fi
    # Bad input, such as a simulator that does not exist; run_local.py prints the message.
    if ((status == 2)); then return; fi
    if ((status != 0)); then install_driver "$answer" "$@"; fi
    SIMULATOR_READY=yes
}

# Installs the packages that `examine_simulator` has named in its first argument; the others are for it.
install_driver() {
    local packages
    read -ra packages <<<"$1"
    shift
    if ((${#packages[@]} == 0)); then
        examine_simulator "$@" >/dev/null || fail "the simulator cannot render; see above"
    fi
    if ! can_install; then
        examine_simulator "$@" >/dev/null || true
        fail "no graphics driver can render; run this script once as root, or as root:" \
            "$(apt_line "${packages[@]}")"
    fi
    say "installing the graphics driver (${packages[*]})"
    if [[ " ${packages[*]} " == *" bookworm-backports "* ]]; then add_backports; fi
    apt_install "${packages[@]}"
    examine_simulator "$@" >/dev/null || fail "the graphics driver still cannot render; see above"
}

# Succeeds if the selected simulator can render. Otherwise it prints the packages to install, if any,
# and writes to standard error what is wrong and what to do. With status 3 it prints the extras to install.
examine_simulator() {
    "$VENV/bin/python" -m actors.backends --config "$ROOT/deploy/config/experiment1.yaml" "$@"
}

# Adds bookworm-backports from this machine's mirror of Debian 12.
add_backports() {
    local list=/etc/apt/sources.list.d/bookworm-backports.list
    if apt-get indextargets --format '$(RELEASE)' | grep -qx bookworm-backports; then return; fi
    local mirror
    mirror="$(apt-get indextargets --format '$(RELEASE) $(REPO_URI)' | awk '$1 == "bookworm" { print $2; exit }')"
    [[ -n "$mirror" ]] || fail "this machine's package sources name no mirror of Debian 12; add bookworm-backports by hand"
    echo "deb $mirror bookworm-backports main" | as_root tee "$list" >/dev/null
    say "added $list"
}

# --- the system's packages --------------------------------------------------------------------

can_install() {
    command -v apt-get >/dev/null || return 1
    [[ $EUID -eq 0 ]] && return
    # Without a terminal sudo cannot ask for a password.
    if [[ -t 0 ]]; then command -v sudo >/dev/null; else sudo -n true 2>/dev/null; fi
}

as_root() {
    if [[ $EUID -eq 0 ]]; then "$@"; else sudo "$@"; fi
}

apt_line() { echo "apt-get install --no-install-recommends $*"; }

apt_install() {
    local log
    log="$(mktemp)"
    if ! { as_root apt-get update -qq &&
        as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@"; } \
        </dev/null >"$log" 2>&1; then
        tail -n 20 "$log" >&2
        fail "the packages could not be installed: $*"
    fi
    rm -f "$log"
}
