#!/usr/bin/env bash
# The units as systemd reads them, their exposure, and the scripts as shellcheck reads them. Usage: units.sh FOLDER
# shellcheck source-path=SCRIPTDIR
source "$(dirname "${BASH_SOURCE[0]}")/common.sh"
need systemd-analyze systemd

copy=$work/units
mkdir -p "$copy"
for unit in "$root"/deploy/systemd/*.service; do
    sed 's#/opt/zbridge/bin/zbridge#/bin/true#' "$unit" >"$copy/$(basename "$unit")"
done
systemd-analyze verify --man=no "$copy"/*.service 2>&1 | grep -F "$copy" && fail "systemd-analyze verify"
ok "systemd-analyze verify has nothing to say"
for unit in "$root"/deploy/systemd/*.service; do
    level=$(systemd-analyze security --offline=true --threshold=30 "$unit" 2>&1 | tail -n 1) || fail "$level"
    ok "$(basename "$unit"): exposure $(grep -o "[0-9]\.[0-9]" <<<"$level"), 3.0 at most"
done
if command -v shellcheck >/dev/null; then
    shellcheck -x "$root"/deploy/{,try/,container/}*.sh || fail shellcheck
    ok "shellcheck has nothing to say"
else
    echo "not tried: shellcheck is missing"
fi
