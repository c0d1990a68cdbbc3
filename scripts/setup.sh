# Sourced by scripts/run and scripts/test: makes .venv beside this folder, once, from constraints.txt.
# Usage: setup_venv EXTRAS, where EXTRAS is "" or a list such as "dev,tools".

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)

find_python() {
    local name
    for name in "${SBT_PYTHON:-}" python3 python3.14 python3.13 python3.12 python3.11 python; do
        [ -n "$name" ] || continue
        if "$name" -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; then
            echo "$name"
            return 0
        fi
    done
    echo "error: sumo-sbt needs Python >= 3.11 with venv, but found $(python3 --version 2>&1 || echo none);" \
        "install it, or name it in SBT_PYTHON" >&2
    return 2
}

setup_venv() {
    local extras=$1 python wanted stamp
    wanted=$(cat "$root/pyproject.toml" "$root/constraints.txt" | cksum)
    for stamp in "$root/.venv/.installed-$extras" "$root/.venv/.installed-dev,tools"; do # which holds all that the bare one does
        if [ -x "$root/.venv/bin/sumo-sbt" ] && [ "$(cat "$stamp" 2>/dev/null)" = "$wanted" ]; then
            return 0
        fi
    done
    if [ ! -x "$root/.venv/bin/python" ]; then
        python=$(find_python) || return 2
        echo "setting up $root/.venv ..." >&2
        "$python" -m venv "$root/.venv" || {
            echo "error: $python cannot make $root/.venv" >&2
            return 2
        }
    fi
    echo "installing sumo-sbt${extras:+ with $extras} (a minute or two) ..." >&2
    "$root/.venv/bin/python" -m pip install --quiet --disable-pip-version-check \
        --constraint "$root/constraints.txt" --editable "$root${extras:+[$extras]}" >&2 || {
        echo "error: the installation failed, see the lines above" >&2
        return 2
    }
    echo "$wanted" >"$root/.venv/.installed-$extras"
}
