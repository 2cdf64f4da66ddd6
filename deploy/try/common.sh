# shellcheck shell=bash disable=SC2154
# What the parts of deploy/try.sh share. root, work: from deploy/try.sh.
set -euo pipefail

need() { # TOOL PACKAGE: end the part where a tool is missing
    command -v "$1" >/dev/null || { echo "$1 is missing: install the package $2"; exit 77; }
}

as_root() {
    [ "$(id -u)" -eq 0 ] || { echo "root is needed"; exit 77; }
}

ok() { echo "ok: $*"; }
fail() { echo "FAILED: $*"; exit 1; }

tools() { # PACKAGE...: Python packages of the checks, in an environment of their own
    [ -x "$work/tools/bin/python" ] || python3 -m venv "$work/tools"
    "$work/tools/bin/pip" install --quiet --disable-pip-version-check "$@" 2>"$work/pip.log" || { tail -n 2 "$work/pip.log"; echo "not to be had: $*"; exit 77; }
}

wheels() { # zbridge and all that it needs, as a host without a network is given it
    [ -d "$work/wheels" ] || python3 -m pip wheel --quiet --disable-pip-version-check -w "$work/wheels" "${root}[certs,serial]" 2>"$work/pip.log" \
        || { tail -n 2 "$work/pip.log"; fail "no wheels"; }
}

debian() { # FOLDER-OR-TAR PACKAGES: a Debian 12; ZBRIDGE_TRY_CACHE keeps it for the next time
    local made=${ZBRIDGE_TRY_CACHE:-$work}/debian-${2//,/-}.tar
    [ -f "$made" ] || mmdebstrap --quiet --variant=minbase --include="$2" bookworm "$made" 2>"$work/mmdebstrap.log" \
        || { tail -n 2 "$work/mmdebstrap.log"; exit 77; }
    case $1 in
        *.tar) ln -f "$made" "$1" 2>/dev/null || cp "$made" "$1" ;;
        *) mkdir "$1" && tar -C "$1" -xf "$made" ;;
    esac
}
