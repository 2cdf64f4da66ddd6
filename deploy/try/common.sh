# shellcheck shell=bash disable=SC2034
# Functions for all parts of deploy/try.sh. Each part takes one argument, its working folder.
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
work=$(realpath "${1:?expected the folder of this run}")

need() { # TOOL PACKAGE: ends the part if a tool is missing
    command -v "$1" >/dev/null || { echo "$1 is missing: install the package $2"; exit 77; }
}

as_root() {
    [ "$(id -u)" -eq 0 ] || { echo "root is needed"; exit 77; }
}

ok() { echo "ok: $*"; }
fail() { echo "FAILED: $*"; exit 1; }

within() { # SECONDS COMMAND...: waits until a command succeeds
    local end=$((SECONDS + $1))
    shift
    until "$@" >/dev/null 2>&1; do [ $SECONDS -lt $end ] || return 1; sleep 0.2; done
}

page() { # URL: prints the status, the type and the text of a page
    python3 -c 'import sys, urllib.error, urllib.request
try: found = urllib.request.urlopen(sys.argv[1], timeout=5)
except urllib.error.HTTPError as error: found = error
print(found.status, found.headers["Content-Type"], found.read().decode(), sep="\n")' "$1"
}

answers() { # URL TEXT: succeeds if a page has a line that begins with TEXT
    page "$1" | grep "^$2" >/dev/null
}

tools() { # PACKAGE...: installs Python packages for the checks in a virtual environment
    [ -x "$work/tools/bin/python" ] || python3 -m venv "$work/tools"
    "$work/tools/bin/pip" install --quiet --disable-pip-version-check "$@" 2>"$work/pip.log" || { tail -n 2 "$work/pip.log"; echo "could not be installed: $*"; exit 77; }
}

wheel() { # FOLDER PIP-ARGUMENTS...
    python3 -m pip wheel --quiet --disable-pip-version-check -w "$@" 2>"$work/pip.log" || { tail -n 2 "$work/pip.log"; fail "the wheels could not be built"; }
}

debian() { # FOLDER-OR-TAR PACKAGES: makes a Debian 12; ZBRIDGE_TRY_CACHE keeps it for the next run
    local made=${ZBRIDGE_TRY_CACHE:-$work}/debian-${2//,/-}.tar
    [ -f "$made" ] || mmdebstrap --quiet --variant=minbase --include="$2" bookworm "$made" 2>"$work/mmdebstrap.log" \
        || { tail -n 2 "$work/mmdebstrap.log"; exit 77; }
    case $1 in
        *.tar) ln -f "$made" "$1" 2>/dev/null || cp "$made" "$1" ;;
        *) mkdir "$1" && tar -C "$1" -xf "$made" ;;
    esac
}
