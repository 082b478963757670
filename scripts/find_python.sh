#!/bin/sh
# Print the path of a Python >= 3.12 with venv: on PATH, or under ~/.pyenv/versions.
# A pyenv shim may be on PATH and still refuse to run, so every candidate is tried.
check='import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 12))'
for python in python3.13 python3.12 python3.14 python3 python \
    "$HOME"/.pyenv/versions/3.13*/bin/python3 "$HOME"/.pyenv/versions/3.12*/bin/python3 \
    "$HOME"/.pyenv/versions/*/bin/python3; do
    if "$python" -c "$check" >/dev/null 2>&1; then
        "$python" -c 'import sys; print(sys.executable)'
        exit 0
    fi
done
echo "trustbo needs Python 3.12 or newer with venv, on PATH or under ~/.pyenv/versions; found none." >&2
echo "Install one (apt: python3 python3-venv; or: pyenv install 3.13), then run make again." >&2
exit 1
