#!/bin/sh
# Make .venv hold the packages of one use: `demo` (what flies, and the replay harness) or `dev` (everything, and GL).
# Does nothing when that was done before and pyproject.toml has not changed since.
set -eu
use=${1:?usage: bootstrap.sh demo|dev}
CDPATH= cd "$(dirname "$0")/.."

say() { printf 'setup: %s\n' "$*" >&2; }

apt_install() {
    if ! command -v apt-get >/dev/null; then
        say "please install these with your system's package manager, then run this again: $*"; exit 2
    fi
    sudo=""
    if [ "$(id -u)" -ne 0 ]; then
        if ! sudo -n true 2>/dev/null; then
            say "system packages are missing and this is not root; run: sudo apt-get install $*"; exit 2
        fi
        sudo="sudo -n"
    fi
    say "installing system packages: $*"
    # A machine that has just started often updates itself. `install` can wait for that, `update` cannot.
    tries_left=60
    until problem=$($sudo env LC_ALL=C apt-get update -qq 2>&1); do
        case $problem in
        *"Could not get lock"*) ;;
        *) say "apt-get update failed: $problem"; exit 2 ;;
        esac
        [ "$tries_left" -lt 60 ] || say "waiting for another apt, for at most five minutes"
        tries_left=$((tries_left - 1))
        [ "$tries_left" -gt 0 ] || { say "$problem"; exit 2; }
        sleep 5
    done
    $sudo env DEBIAN_FRONTEND=noninteractive apt-get -o DPkg::Lock::Timeout=300 install -y -qq \
        --no-install-recommends "$@" >/dev/null
}

find_python() {
    for candidate in python3 python3.14 python3.13 python3.12 python3.11; do
        if command -v "$candidate" >/dev/null &&
            "$candidate" -c 'import sys; raise SystemExit(not (3, 11) <= sys.version_info[:2] <= (3, 14))' 2>/dev/null; then
            echo "$candidate"; return
        fi
    done
    return 1
}

# Its commands name the folder that they were installed in: in a copied or moved checkout they would run the code of the
# original, or none.
made_elsewhere() {
    [ ! -L .venv ] && [ -e .venv/bin/pip ] && ! head -n 2 .venv/bin/pip | grep -qF "$(pwd -P)/.venv/bin/"
}

if [ ! -x .venv/bin/python ] || ! .venv/bin/python -m pip --version >/dev/null 2>&1 || made_elsewhere; then
    if ! python=$(find_python); then
        apt_install python3 python3-venv
        python=$(find_python) || { say "Python 3.11 to 3.14 is needed and none was found"; exit 2; }
    fi
    "$python" -c 'import ensurepip, venv' 2>/dev/null || apt_install "python$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')-venv"
    say "making .venv with $("$python" --version)"
    # What is left of one that another Python made, before an upgrade of the system, does not count as installed.
    "$python" -m venv --clear .venv
fi

if [ "$use" = dev ]; then
    # The renderer draws through EGL: on a GPU where its driver is there, else in software by Mesa.
    ldconfig=$(command -v ldconfig || echo /sbin/ldconfig)
    $ldconfig -p | grep -q 'libEGL\.so\.1' && $ldconfig -p | grep -q 'libEGL_\(mesa\|nvidia\)\.so\.0' && $ldconfig -p | grep -q 'libGL\.so\.1' ||
        apt_install libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri
    # Certificates of the TLS tests.
    command -v openssl >/dev/null || apt_install openssl
    # The command that we tell the user for a video without times is run.
    command -v ffmpeg >/dev/null || apt_install ffmpeg
    # The flight report is looked at in a real browser.
    command -v chromium >/dev/null || command -v google-chrome >/dev/null || apt_install chromium
fi

stamp=".venv/.$use-$(cat pyproject.toml deploy/constraints.txt | sha256sum | cut -c1-16)"
if [ ! -e "$stamp" ]; then
    case $use in
    demo) extras=replay; needed_mb=1000 ;;
    dev) extras=dev; needed_mb=3800 ;;
    *) say "no such use: $use"; exit 2 ;;
    esac
    free_mb=$(df -Pm . | awk 'NR == 2 { print $4 }')
    there_mb=$(du -sm .venv | cut -f1)  # from before
    needed_mb=$((needed_mb - there_mb))
    if [ "$free_mb" -lt "$needed_mb" ]; then
        say "$free_mb MB are free on the disk of $PWD and the packages for $use need $needed_mb: make room, then run this again"
        exit 2
    fi
    if [ "$use" = dev ] && [ "$free_mb" -lt $((6900 - there_mb)) ]; then
        say "$free_mb MB are free on the disk of $PWD: too few if pip's index offers CUDA builds of torch (see README.md)"
    fi
    say "installing Python packages for $use"
    .venv/bin/python -m pip install -qq --disable-pip-version-check --constraint deploy/constraints.txt --editable ".[$extras]"
    : >"$stamp"
fi
