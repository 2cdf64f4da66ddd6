#!/usr/bin/env bash
# Tries the deployment for real, as far as this machine allows:  sudo bash deploy/try.sh [units] [host] [container] [chart]
# Nothing outside a temporary folder and namespaces of its own is changed. A part that cannot run says why, and is not counted as passed.
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
parts=("$@")
[ ${#parts[@]} -gt 0 ] || parts=(units host container chart)
work=$(mktemp -d /var/tmp/zbridge-try.XXXXXX)
export root work
# What was interrupted may have left mounts below: nothing behind them is removed.
trap 'rm -rf --one-file-system "$work" 2>/dev/null || echo "left behind: $work"' EXIT

passed=0 failed=0 absent=0
for part in "${parts[@]}"; do
    [ -x "$root/deploy/try/$part.sh" ] || { echo "$part: unknown; known are units, host, container, chart" >&2; exit 2; }
    echo "== $part"
    code=0
    "$root/deploy/try/$part.sh" || code=$?
    case $code in
        0) passed=$((passed + 1)); echo "== $part: passed" ;;
        77) absent=$((absent + 1)); echo "== $part: cannot run here" ;;
        *) failed=$((failed + 1)); echo "== $part: FAILED ($code)" ;;
    esac
done
echo "$passed passed, $failed failed, $absent cannot run here"
[ "$failed" -eq 0 ]
