#!/usr/bin/env bash
# Tests the deployment for real, as far as this machine allows:  sudo bash deploy/try.sh [units] [host] [container] [chart]
# Each part has a temporary folder, and devices and a /run of its own. At the end the script checks that the machine outside is unchanged.
# A part that cannot run reports why, and does not count as passed.
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
parts=("$@")
[ ${#parts[@]} -gt 0 ] || parts=(units host container chart)
for part in "${parts[@]}"; do
    case $part in units | host | container | chart) ;; *) echo "$part: unknown part; expected units, host, container or chart" >&2; exit 2 ;; esac
done
work=$(mktemp -d /var/tmp/zbridge-try.XXXXXX)
# An interrupted part may have left mounts below: remove nothing behind them.
trap 'rm -rf --one-file-system "$work" 2>/dev/null || echo "could not remove: $work"' EXIT

outside() { # prints what container programs are known to change: owners of devices, and leftover control groups
    stat --format '%n %U:%G %a %t:%T' /dev/null /dev/zero /dev/full /dev/random /dev/urandom /dev/tty
    find /sys/fs/cgroup -type d \( -name 'libpod*' -o -name payload -o -name supervisor \) 2>/dev/null | sort
}
run() { # PART
    if [ "$(id -u)" -eq 0 ]; then
        unshare --mount --propagation private bash "$root/deploy/try/apart.sh" "$work" "$root/deploy/try/$1.sh" "$work"
    else
        "$root/deploy/try/$1.sh" "$work"
    fi
}

for tool in systemd-nspawn mmdebstrap podman crun shellcheck python3; do
    if command -v $tool >/dev/null; then echo "$tool: $($tool --version 2>&1 | grep --max-count 1 '[0-9]')"; else echo "$tool: missing"; fi
done
outside >"$work/outside"
passed=0 failed=0 absent=0
for part in "${parts[@]}"; do
    echo "== $part"
    began=$SECONDS code=0
    run "$part" || code=$?
    case $code in
        0) passed=$((passed + 1)); echo "== $part: passed, $((SECONDS - began)) s" ;;
        77) absent=$((absent + 1)); echo "== $part: cannot run here" ;;
        *) failed=$((failed + 1)); echo "== $part: FAILED ($code)" ;;
    esac
done
if ! outside | diff "$work/outside" -; then
    failed=$((failed + 1))
    echo "FAILED: devices or control groups of the machine have changed (above)"
else
    echo "ok: the machine's devices and control groups are unchanged"
fi
echo "$passed passed, $failed failed, $absent cannot run here"
[ "$failed" -eq 0 ]
