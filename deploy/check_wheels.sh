#!/bin/sh
# Is there a wheel, at the pinned version, for everything that flies on an Arm board? One pip download for each Python;
# nothing is built. Exit code 1 if one is missing.
#   sh deploy/check_wheels.sh [PLATFORM]      default manylinux_2_28_aarch64
set -u
platform=${1:-manylinux_2_28_aarch64}
CDPATH= cd "$(dirname "$0")/.."
python=.venv/bin/python
[ -x "$python" ] || python=python3
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
# A board takes wheels made for older C libraries too.
older=""
for tag in manylinux_2_28 manylinux_2_27 manylinux_2_26 manylinux_2_24 manylinux_2_17 manylinux2014; do
    older="$older --platform ${tag}_${platform##manylinux_2_28_}"
done
"$python" - >"$folder/pinned.txt" <<'END'
import tomllib
with open("pyproject.toml", "rb") as file:
    print("\n".join(tomllib.load(file)["project"]["dependencies"]))
END
failed=0
for version in 3.11 3.12 3.13 3.14; do
    # shellcheck disable=SC2086
    if "$python" -m pip download -qq --disable-pip-version-check --only-binary=:all: $older \
        --implementation cp --python-version "$version" --constraint deploy/constraints.txt \
        --dest "$folder/$version" --requirement "$folder/pinned.txt"; then
        echo "$platform, Python $version: all $(ls "$folder/$version" | wc -l) wheels are there, $(du -sm "$folder/$version" | cut -f1) MB"
    else
        echo "$platform, Python $version: a wheel is missing"
        failed=1
    fi
done
exit $failed
