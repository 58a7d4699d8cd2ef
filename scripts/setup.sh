#!/usr/bin/env bash
# Makes a virtual environment with the pinned packages, and installs the system libraries Open3D needs where it may.
# usage: scripts/setup.sh PYTHON VENV
set -euo pipefail
cd "$(dirname "$0")/.."
python=${1:-python3}
venv=${2:-.venv}

as_root() {
    if [ "$(id -u)" = 0 ]; then
        "$@"
    elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then
        sudo -n "$@"
    else
        return 1
    fi
}

apt_install() {
    command -v apt-get >/dev/null || return 1
    as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends "$@" </dev/null && return
    as_root apt-get update </dev/null &&
        as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends "$@" </dev/null
}

"$python" - <<'PY' || exit 1
import sys
if sys.version_info < (3, 11):
    sys.exit(f"The pinned packages need Python 3.11 or newer and this is {sys.version.split()[0]}; name another one: make PYTHON=python3.11 …")
PY

if ! [ -x "$venv/bin/python" ] || ! "$venv/bin/python" -m pip --version >/dev/null 2>&1; then
    if ! "$python" -m venv "$venv"; then
        apt_install python3-venv && "$python" -m venv "$venv" || {
            echo "Python's venv module does not work here; install it (Debian, Ubuntu: apt-get install python3-venv) and run make again." >&2
            exit 1
        }
    fi
fi
"$venv/bin/python" -m pip install --quiet --constraint constraints.txt --editable '.[dev]' </dev/null

# The loader names one missing library at a time.
for _ in 1 2 3 4 5 6; do
    if message=$("$venv/bin/python" -c 'import open3d' 2>&1); then
        exit 0
    fi
    case $message in
        *libusb-1.0.so*) package=libusb-1.0-0 ;;
        *libGL.so*) package=libgl1 ;;
        *libEGL.so*) package=libegl1 ;;
        *libgomp.so*) package=libgomp1 ;;
        *libX11.so*) package=libx11-6 ;;
        *) break ;;
    esac
    echo "Open3D needs the system package $package; installing it."
    apt_install "$package" >/dev/null || break
done
echo "Open3D cannot be imported (${message##*$'\n'}); everything without it works, for the rest install" \
    "libusb-1.0-0 libgl1 libegl1 libgomp1 libx11-6 (apt-get) or their like." >&2
