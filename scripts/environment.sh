# Sourced by scripts/demo, scripts/gallery and scripts/test: makes .venv beside pyproject.toml with the package and some extras.
# Running it again costs nothing: a stamp remembers what was installed from which pyproject.toml.

find_python() {
    for candidate in "${PYTHON:-}" python3.13 python3.12 python3.11 python3; do
        if [ -n "$candidate" ] && "$candidate" -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
            echo "$candidate"
            return
        fi
    done
    echo "splatpipe needs Python 3.11 or newer with venv (Debian: apt install python3-venv); set PYTHON to name one" >&2
    exit 2
}

# make_environment EXTRAS: installs splatpipe[EXTRAS] unless that has been done.
make_environment() {
    local extras=$1 stamp
    stamp=.venv/.installed-$(echo "$extras" | tr ',' '-')
    if [ ! -x .venv/bin/python ]; then
        local python
        python=$(find_python) || exit 2
        echo "making .venv with $("$python" --version)"
        "$python" -m venv .venv
    fi
    if ! cmp -s pyproject.toml "$stamp"; then
        echo "installing splatpipe[$extras] into .venv"
        .venv/bin/python -m pip install --quiet --disable-pip-version-check --editable ".[$extras]"
        cp pyproject.toml "$stamp"
    fi
}
