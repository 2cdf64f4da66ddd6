#!/usr/bin/env bash
# Checks the units with systemd-analyze (syntax, exposure), and the scripts with shellcheck. Usage: units.sh FOLDER
# shellcheck source-path=SCRIPTDIR
source "$(dirname "${BASH_SOURCE[0]}")/common.sh"
need systemd-analyze systemd

copy=$work/units
mkdir -p "$copy"
for unit in "$root"/deploy/systemd/*.service; do
    sed 's#/opt/zbridge/bin/zbridge#/bin/true#' "$unit" >"$copy/$(basename "$unit")"
done
systemd-analyze verify --man=no "$copy"/*.service 2>&1 | grep -F "$copy" && fail "systemd-analyze verify"
ok "systemd-analyze verify reports nothing"
for unit in "$root"/deploy/systemd/*.service; do
    level=$(systemd-analyze security --offline=true --threshold=30 "$unit" 2>&1 | tail -n 1) || fail "$level"
    ok "$(basename "$unit"): exposure $(grep -o "[0-9]\.[0-9]" <<<"$level") (limit 3.0)"
done
if command -v shellcheck >/dev/null; then
    shellcheck -x "$root"/deploy/{,try/,container/}*.sh || fail shellcheck
    ok "shellcheck reports nothing"
else
    echo "not tried: shellcheck is missing"
fi
